"""Presets fill in what a data sheet states, and what is stated takes precedence."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from rovgraph.cli.logs import preset_tables
from rovgraph.errors import DataWarning, InputError
from rovgraph.model.config import Config, describe, load_config, parse_config
from rovgraph.model.presets import LISTS, TRIPLES, UNITS, Fact, Preset, presets

ROOT = Path(__file__).parents[1]


def leaf(config: Config, key: str) -> object:
    value: object = config
    for part in key.split("."):
        value = getattr(value, part)
    return value


def stated(text: str) -> Config:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        return parse_config(text)


def test_a_preset_fills_in_noise_and_priors() -> None:
    config = parse_config("imu: {preset: xsens-mti-g-710}\ndvl: {preset: waterlinked-a50}")
    assert config.imu.noise.gyr == pytest.approx(np.deg2rad(0.01), rel=1e-3)
    assert config.imu.noise.acc == pytest.approx(60e-6 * 9.80665, rel=1e-3)
    assert config.calibration.dvl_scale.sd == 0.0101
    assert config.imu.noise.acc_walk == Config().imu.noise.acc_walk  # not stated by the data sheet


def test_units_of_data_sheets_are_converted() -> None:
    fog = presets()["kvh-1750"].facts[0].value  # 0.012 deg/sqrt(h) is 0.0002 deg/s/sqrt(Hz)
    assert fog == pytest.approx(np.deg2rad(2e-4), rel=1e-3)
    assert presets()["nortek-dvl500"].facts[0].value == (0.008, 0.008, 0.008)
    assert UNITS["imu.gyr_bias_sd_dps"]["deg/h"] == 1 / 3600


@pytest.mark.parametrize("preset", presets().values(), ids=presets().keys())
def test_every_preset_reaches_the_configuration_with_a_source_for_each_number(preset: Preset) -> None:
    config = stated(f"{preset.kind}: {{preset: {preset.name}}}")
    keys = {key for key, *_ in describe()}
    assert preset.facts or preset.notes[0].startswith("fills in nothing: ")
    for fact in preset.facts:
        assert fact.key in keys and fact.source.strip()
        assert leaf(config, fact.key) == fact.value
        assert isinstance(fact.value, tuple) == (fact.key in (*TRIPLES, *LISTS))


def test_a_preset_without_numbers_says_so_and_changes_nothing() -> None:
    assert presets()["sontek-3-beams"].facts == ()
    config = parse_config("dvl: {preset: sontek-3-beams}")
    assert config.changed(dvl={"preset": None}) == Config()
    assert "| nothing | fills in nothing: " in preset_tables()
    assert "70 mm above" in preset_tables()


def test_a_preset_says_where_the_beams_of_a_dvl_point() -> None:
    assert parse_config("dvl: {preset: waterlinked-a50}").dvl.beams.azimuth_deg == (135.0, 225.0, 315.0, 45.0)
    assert parse_config("dvl: {preset: waterlinked-a50}").dvl.beams.first_number == 0
    pathfinder = parse_config("dvl: {preset: teledyne-pathfinder, beams: {angle_deg: 29.9}}").dvl.beams
    assert (pathfinder.angle_deg, pathfinder.phased, pathfinder.azimuth_deg[2]) == (29.9, True, 0.0)
    assert not parse_config("dvl: {preset: nortek-dvl1000}").dvl.beams.azimuth_deg  # no source: it is fitted


def _own(fact: Fact) -> object:
    """Another value than the preset's."""
    others = {"dvl.beams.azimuth_deg": [10.0, 130.0, 250.0], "dvl.beams.first_number": 1 - int(fact.value == 1)}
    others |= {key: [0.5, 0.6, 0.7] for key in TRIPLES} | {"dvl.beams.phased": False}
    return others.get(fact.key, 0.5)


@pytest.mark.parametrize("preset", presets().values(), ids=presets().keys())
def test_what_the_user_states_takes_precedence(preset: Preset) -> None:
    for fact in preset.facts:
        own = _own(fact)
        section, *path = fact.key.split(".")
        text = f"{section}: " + "".join(f"{{{p}: " for p in path) + str(own).lower() + "}" * len(path)
        if section == preset.kind:
            text = text.replace("{", f"{{preset: {preset.name}, ", 1)
        else:
            text += f"\n{preset.kind}: {{preset: {preset.name}}}"
        assert leaf(stated(text), fact.key) == (tuple(own) if isinstance(own, list) else own)


def test_the_effective_configuration_reads_back_as_it_was() -> None:
    config = parse_config("imu: {preset: xsens-mti-630, noise: {acc: 1.0e-3}}\ndvl: {preset: nortek-dvl1000}")
    assert parse_config(config.to_yaml()) == config


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("imu: {preset: xsens-mti-6300}", "imu.preset: expected a preset, nearest is xsens-mti-630 "),
        ("dvl: {preset: Waterlinked A50}", "dvl.preset: expected a preset, nearest is waterlinked-a50 "),
        ("dvl: {preset: xsens-mti-300}", "dvl.preset: expected a preset"),
        ("imu: {preset: 5}", "imu.preset: expected text, found 5"),
        ("imu: {preset: [a]}", "imu.preset: expected text"),
        ("imu: {preset: kvh-1750, noise: 3}", "imu.noise: expected keys and values"),
        ("calibration: 3\ndvl: {preset: waterlinked-a50}", "calibration: expected keys and values"),
    ],
)
def test_a_wrong_preset_is_one_clear_line(text: str, said: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_config(text, "c.yaml")
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("imu: {noise: {gyr: 3.5e-6}}", "imu.gyr_bias_sd_dps = 0.6 is that of a much coarser instrument"),
        ("imu: {preset: kvh-1750}", "imu.gyr_bias_sd_dps = 0.6 is that of a much coarser instrument"),
        ("imu: {noise: {gyr: 3.5e-6}, gyr_bias_sd_dps: 0.0006}", None),
        ("imu: {gyr_bias_sd_dps: 0.0005}", "imu.gyr_bias_sd_dps = 0.0005 is that of a much finer"),
        ("imu: {noise: {acc: 3.0e-5}}", "imu.acc_bias_sd_mps2 = 0.05 is that of"),
        ("imu: {acc_bias_sd_mps2: 1.0e-5}", "imu.acc_bias_sd_mps2 = 1e-05 is that of a much finer"),
        ("{}", None),
    ],
)
def test_noise_of_one_grade_beside_a_bias_of_another_is_warned_of(text: str, said: str | None) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        parse_config(text, "c.yaml")
    texts = [str(w.message) for w in caught if issubclass(w.category, DataWarning)]
    assert (not texts) if said is None else any(t.startswith(f"c.yaml: {said}") for t in texts)


@pytest.mark.parametrize("path", [*ROOT.glob("rovgraph/model/*.yaml"), *ROOT.glob("data/*/*.yaml")], ids=str)
def test_shipped_configurations_mix_no_grades(path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", DataWarning)
        load_config(path)


@pytest.mark.parametrize("name", [n for n, p in presets().items() if p.kind == "imu" and n != "kvh-1750"])
def test_presets_beside_the_default_priors_mix_no_grades(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", DataWarning)
        parse_config(f"imu: {{preset: {name}}}")


def test_the_manual_lists_the_presets() -> None:
    manual = (ROOT / "docs" / "presets.md").read_text(encoding="utf-8")
    assert preset_tables() in manual, "renew the tables with: rovgraph config --presets --markdown"
