"""Simulate, plan and observe: which manoeuvre shows how the DVL is turned, and did the dive show it?

Writes simulate_plan_observe.png. The work is in a function, because rg.plan starts processes, which import this
file again.
"""

import math

import matplotlib.pyplot as plt

import rovgraph as rg


def main() -> None:
    config = rg.parse_config("calibration: {dvl_yaw: {estimate: true, sd_deg: 5}}")

    # before the dive: a minute of which manoeuvre leaves the smallest sd?
    goals = {"dvl_yaw": math.radians(1.0)}
    planned = rg.plan(config, goals, duration=60.0, manoeuvres=["straight@0.5", "circle@0.5", "square@0.5"])
    plan = planned.plan
    column = plan.labels.index("dvl_yaw")
    promised = {str(one.manoeuvre): math.degrees(one.sd[column]) for one in plan.ranked}
    for name, sd in promised.items():
        print(f"{name}: dvl_yaw known to {sd:.1f}° (5° before)")

    # the dive itself, here a simulated one, and what it showed
    best = plan.ranked[0].manoeuvre
    dive = rg.simulate(best.name, config, seed=1, choices=rg.Choices(duration=60, speed=best.speed))
    observed = rg.observe(dive.log, dive.config)
    print(f"after the {best}: dvl_yaw is {observed.verdicts['dvl_yaw']}")
    yaw = rg.smooth(dive.log, dive.config, estimate="smoothed").calibration["dvl_yaw"]
    print(f"estimated {math.degrees(yaw.value):.1f}° ± {math.degrees(yaw.sd):.1f}°")

    figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
    bars = axes.barh(list(promised), list(promised.values()))
    axes.bar_label(bars, fmt="%.1f°", padding=3)
    axes.axvline(1.0, color="k", linestyle=":", label="wanted")
    axes.set(xlabel="sd of the DVL's yaw after a minute [°]", xlim=(0, 5.5))
    axes.invert_yaxis()
    axes.legend()
    figure.savefig("simulate_plan_observe.png", dpi=150)


if __name__ == "__main__":
    main()
