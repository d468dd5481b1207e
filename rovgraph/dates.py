"""Times as people write them, as seconds: dates, times of day, and the day numbers of other programs.

pandas parses; this module decides the order of day and month, the zone, and the epoch of numbers. A date without a
zone is in UTC unless `DateRules` state another zone. A date that may mean two days is refused with both readings.

GPS time, weeks and seconds since 1980 without leap seconds, is converted to Unix time and back. Leap seconds are those
of IERS Bulletin C; the last was that of 2017.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array

EPOCH, WEEK_S = 315_964_800.0, 604_800.0  # in Unix time; [s]
WEEKS = 1356, 4000  # a receiver that states another has not learnt the week: 2006 to 2056
UNIX = 315_532_800.0, 4_102_444_800.0  # 1980, which no clock that counts from its start reaches, to 2100 [s]
_LEAPS = np.array([1136073600.0, 1230768000.0, 1341100800.0, 1435708800.0, 1483228800.0])  # Unix times of leap seconds
_FIRST_LEAP = 13  # seconds that GPS was ahead of UTC before the first of them


def unix_of_gps(week: ArrayLike, seconds: ArrayLike) -> Array:
    """Unix time [s] of weeks and seconds of the week, shape (n,)."""
    ahead = EPOCH + WEEK_S * np.asarray(week, dtype=float) + np.asarray(seconds, dtype=float)
    leaps = np.searchsorted(_LEAPS + _FIRST_LEAP + 1 + np.arange(len(_LEAPS)), ahead, side="right")
    return np.asarray(ahead - _FIRST_LEAP - leaps)


def gps_of_unix(unix: ArrayLike) -> tuple[Array, Array]:
    """Weeks and seconds of the week [s] of Unix times [s], each of their shape."""
    time = np.asarray(unix, dtype=float)
    week, seconds = np.divmod(time - EPOCH + _FIRST_LEAP + np.searchsorted(_LEAPS, time, side="right"), WEEK_S)
    return np.asarray(week), np.asarray(seconds)


def is_unix(time: ArrayLike) -> bool:
    """Whether times [s], any shape, count from 1970."""
    known = np.asarray(time, dtype=float)
    return bool(known.size) and bool(((known >= UNIX[0]) & (known < UNIX[1])).all())


def is_week(week: ArrayLike) -> NDArray[np.bool_]:
    """Whether a receiver knew the week, shape (n,)."""
    known = np.asarray(week, dtype=float)
    return np.asarray((known >= WEEKS[0]) & (known <= WEEKS[1]))


Moments = Any  # seconds, a date (pandas, datetime, ISO text), or an array of either


def seconds_of_moments(given: Moments, clock: Array, name: str) -> Array:
    """Times that a caller names, by a clock, in the shape that they have [s].

    Parameters
    ----------
    given : seconds of the clock; or dates, of pandas, numpy or datetime or as ISO text, in UTC without a zone
    clock : ndarray, shape (n,), times of the clock [s]
    name : of the argument, for messages

    Raises
    ------
    InputError : neither numbers nor dates; dates for a clock that is not Unix time
    """
    values = np.asarray(given)
    if values.dtype.kind in "iuf" and not isinstance(given, np.timedelta64):
        return values.astype(float)
    try:
        dates = pd.to_datetime(pd.Series(values.ravel()), utc=True, format="ISO8601")
        if values.dtype.kind not in "OUM" or (values.size and dates.isna().all()):
            raise ValueError
    except (ValueError, TypeError, OverflowError):
        raise InputError(f"{name} {_shown(given)}: expected seconds or a date such as 2026-05-01T09:30:00Z") from None
    if not is_unix(clock):
        begin = f"{float(clock[0]):.10g} s" if len(clock) else "no time"
        raise InputError(
            f"{name} {_shown(given)}: is a date, but the track's clock is not Unix time (it begins at {begin})"
        )
    seconds = np.asarray((dates - pd.Timestamp(0, tz="UTC")).dt.total_seconds(), dtype=float)
    return np.asarray(seconds.reshape(values.shape))


def _shown(given: object) -> str:
    text = str(given).replace("\n", " ")
    return text if len(text) < 50 else text[:47] + "..."


Order = Literal["dmy", "mdy"]

DAY_S = 86400.0
YEAR_FIRST = "write the year first, such as 2026-05-01 09:30"  # where the order cannot be stated
# epoch of a program's numbers -> day of 1970 in it, and seconds of its unit
LONGEST_STEP_S = 3600.0  # between rows of a table, that is likely
EPOCHS = {"excel": (25569.0, DAY_S), "matlab": (719529.0, DAY_S), "labview": (2_082_844_800.0, 1.0)}
UNIX_UNITS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
YEARS = 946_684_800.0, 2_840_140_800.0  # 2000 to 2060, within which a number is taken for a date of some program [s]
LONGEST_STEP = 5e-4  # between day numbers [days]: in seconds it is 2 kHz, which no log has
_FORM = (
    r"^(?:(?P<a>\d{1,4})(?P<sep>[-./])(?P<b>\d{1,2})(?P=sep)(?P<c>\d{1,4}))?(?:(?<=\d)[T ,]+)?"
    r"(?:(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<second>\d{2}(?:[.,]\d*)?))?\s*(?P<half>[AaPp]\.?[Mm]\.?)?)?"
    r"\s*(?P<zone>Z|UTC|GMT|[+-]\d{2}:?\d{2}|[+-]\d{2})?$"
)
_ISO = re.compile(r"\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}:\d{2}|\d{8}T\d{6}")


@dataclass(frozen=True)
class DateRules:
    """Rules for dates that texts leave open.

    Attributes
    ----------
    order : of day and month; None = as the dates themselves show
    zone_h : hours ahead of UTC of dates without a zone [h]
    date : day of times of day, YYYY-MM-DD; None = not known
    remedy : what to do about a date that may mean two days
    """

    order: Order | None = None
    zone_h: float = 0.0
    date: str | None = None
    remedy: str = "state times: {order: dmy} (day first) or times: {order: mdy} (month first)"


def is_text(cells: "pd.Series[Any]") -> bool:
    """Whether a column holds texts other than numbers, as dates are."""
    if cells.dtype.kind in "biufc":
        return False
    known = cells.dropna().astype(str).str.strip()
    known = known[known != ""]
    return bool(len(known)) and bool(pd.to_numeric(known, errors="coerce").isna().any())


def seconds_of_texts(cells: "pd.Series[Any]", rules: DateRules, where: Callable[[int], str]) -> tuple[Array, str]:
    """Unix time of dates, or seconds since midnight of times of day without a date, which go on after midnight.

    Parameters
    ----------
    cells : texts, n of them; missing or blank = no time
    where : place of a row in its file, for messages

    Returns
    -------
    time : ndarray, shape (n,) [s], NaN where there is none
    how : how they were read, a phrase

    Raises
    ------
    InputError : a text that is not a time; a date that may mean two days

    >>> seconds_of_texts(pd.Series(["01.05.2026 09:30:00,5"]), DateRules(), str)[0]
    array([1.7776278e+09])
    """
    texts = cells.astype(object).where(cells.notna(), "").astype(str).str.strip()
    stated = (texts != "").to_numpy()
    zone = f"UTC{rules.zone_h:+g} h" if rules.zone_h else "UTC"
    if _ISO.match(texts[stated].iloc[0]) if stated.any() else False:
        dates = pd.to_datetime(texts.where(stated).str.replace(",", "."), format="ISO8601", utc=True, errors="coerce")
        if not (dates.isna() & stated).any() and not rules.zone_h:
            stating = texts[stated].str.contains(r"(?:Z|[+-]\d\d:?\d\d)$").all()
            return _unix(dates), "dates" if stating else f"dates, in {zone} where they state no zone"
    parts = texts.str.extract(_FORM)
    dated, clocked = parts["a"].notna().to_numpy(), parts["hour"].notna().to_numpy()
    if (odd := np.flatnonzero(stated & ~dated & ~clocked)).size:
        return _with_month_names(texts, stated, rules, where, int(odd[0])), f"dates, in {zone}"
    if (odd := np.flatnonzero(stated & (dated != dated[np.argmax(stated)]))).size:
        raise InputError(f"{where(int(odd[0]))}: {texts.iloc[odd[0]]!r}: expected a date in every row, or in none")
    of_day = _seconds_of_day(parts)
    if (odd := np.flatnonzero(stated & np.isnan(of_day))).size:
        raise InputError(f"{where(int(odd[0]))}: {texts.iloc[odd[0]]!r} is not a time; write it as 09:30:00.5")
    if not dated.any():
        return _time_of_day(of_day, rules)
    order = _order(parts, texts, rules, where, of_day)
    day = pd.to_datetime(_iso_days(parts, order).where(stated), format="%Y-%m-%d", utc=True, errors="coerce")
    if (odd := np.flatnonzero(day.isna() & stated)).size:
        raise InputError(f"{where(int(odd[0]))}: {texts.iloc[odd[0]]!r} is not a date; write it as 2026-05-01 09:30:00")
    offset = _zones(parts["zone"], rules.zone_h)
    first = "" if order is None else {"dmy": ", day first", "mdy": ", month first"}[order]
    return _unix(day) + of_day - offset, f"dates{first}, in {zone} where they state no zone"


def seconds_of_numbers(values: Array) -> tuple[Array, str]:
    """Seconds of numbers that are Unix time in another unit, or day numbers of Excel or MATLAB, by their size.

    Parameters
    ----------
    values : ndarray, shape (n,), NaN = no time

    Returns
    -------
    time : ndarray, shape (n,) [s]
    how : unit or program, "" = seconds as they are
    """
    known = values[np.isfinite(values)]
    middle = float(np.median(known)) if len(known) else 0.0
    if abs(middle) < 3e4:  # most logs: nothing of this size is a date
        return values, ""
    for unit, factor in UNIX_UNITS.items():
        if YEARS[0] < middle * factor < YEARS[1]:
            return values * factor, f"Unix time in {unit}"
    for program, (zero, unit_s) in EPOCHS.items():
        if YEARS[0] < (middle - zero) * unit_s < YEARS[1]:
            steps = np.diff(np.unique(known))
            if unit_s == DAY_S and not (len(steps) and np.median(steps) < LONGEST_STEP):
                continue
            if len(steps) and np.median(steps) * unit_s > LONGEST_STEP_S:  # a counter of microseconds
                continue
            return (values - zero) * unit_s, _PROGRAMS[program]
    return values, ""


_PROGRAMS = {
    "excel": "Excel's day numbers",
    "matlab": "MATLAB's day numbers",
    "labview": "LabVIEW's seconds since 1904",
}


def unix_of_epoch(values: Array, program: str) -> Array:
    """Unix time [s] of numbers of a program, a key of `EPOCHS`, shape (n,)."""
    zero, unit_s = EPOCHS[program]
    return np.asarray((values - zero) * unit_s)


def seconds_of_day_and_time(
    day: "pd.Series[Any]", time: "pd.Series[Any]", rules: DateRules, where: Callable[[int], str]
) -> tuple[Array, str] | None:
    """Unix time of day and time in two columns; None where the day says nothing of these times.

    The day is a date, YYYYMMDD, Excel's day number beside fractions of a day, or a GPS week beside its seconds.

    Raises
    ------
    InputError : as `seconds_of_texts`
    """
    if is_text(time):
        texts = day.astype(object).where(day.notna(), "").astype(str).str.strip().str.replace(r"\.0$", "", regex=True)
        texts = texts.str.replace(r"^(\d{4})(\d\d)(\d\d)$", r"\1-\2-\3", regex=True)
        clock = time.astype(object).where(time.notna(), "").astype(str).str.strip()
        days = texts.str.partition(" ")[0] if is_text(day) else texts  # Excel writes 01.05.2026 00:00
        both = (days + " " + clock).where((clock != "") & (days != ""), "")
        return seconds_of_texts(both, rules, where)
    count, seconds = (pd.to_numeric(each, errors="coerce").to_numpy(float) for each in (day, time))
    known = np.isfinite(count) & np.isfinite(seconds)
    if not known.any():
        return None
    low, high = count[known].min(), count[known].max()
    if low >= 1000.0 and high <= 4000.0 and seconds[known].min() >= 0.0 and seconds[known].max() < 604_801.0:
        return np.where(
            known, unix_of_gps(np.nan_to_num(count), np.nan_to_num(seconds)), np.nan
        ), "GPS weeks and seconds"
    if low > 36525.0 and high < 60000.0 and seconds[known].min() >= 0.0 and seconds[known].max() < 1.0:
        return unix_of_epoch(count + seconds, "excel"), _PROGRAMS["excel"]
    return None


def _unix(dates: "pd.Series[Any]") -> Array:
    since = dates.dt.as_unit("us") - pd.Timestamp(0, tz="UTC").as_unit("us")  # nanoseconds reach 2262 alone
    return np.asarray(since.dt.total_seconds(), dtype=float)


def _seconds_of_day(parts: pd.DataFrame) -> Array:
    """Seconds since midnight, NaN where a field is out of its range; 0 without a time of day."""
    hour, minute = (parts[name].fillna("0").astype(float).to_numpy() for name in ("hour", "minute"))
    second = parts["second"].fillna("0").str.replace(",", ".").astype(float).to_numpy()
    half = parts["half"].fillna("").str[:1].str.lower().to_numpy()
    twelve = half != ""
    sound = (hour < 24) & (minute < 60) & (second < 61) & (~twelve | ((hour >= 1) & (hour <= 12)))
    hour = np.where(twelve, hour % 12 + 12.0 * (half == "p"), hour)
    return np.where(sound, 3600.0 * hour + 60.0 * minute + second, np.nan)


def _time_of_day(of_day: Array, rules: DateRules) -> tuple[Array, str]:
    out = np.full(len(of_day), np.nan)
    known = np.isfinite(of_day)
    steps: Array = np.diff(of_day[known], prepend=of_day[known][:1])
    days: Array = np.cumsum(steps < -0.5 * DAY_S) - np.cumsum(
        steps > 0.5 * DAY_S
    )  # rows around midnight may be out of order
    out[known] = of_day[known] + DAY_S * days
    if rules.date is None:
        return out, "times of day without a date, as seconds since midnight"
    day = pd.Timestamp(rules.date, tz="UTC").timestamp()
    return out + day - 3600.0 * rules.zone_h, f"times of day of {rules.date}"


def _order(
    parts: pd.DataFrame, texts: "pd.Series[Any]", rules: DateRules, where: Callable[[int], str], of_day: Array
) -> Order | None:
    """Order of day and month; None = year first.

    Raises
    ------
    InputError : both are possible
    """
    rows = parts["a"].notna()
    if (parts["a"][rows].str.len() > 2).all():
        return None
    if rules.order is not None:
        return rules.order
    if (parts["sep"][rows] == ".").all():  # with points the month is never first
        return "dmy"
    first, second = (parts[name][rows].astype(int).to_numpy() for name in "ab")
    orders: tuple[tuple[Order, Any], ...] = (("dmy", second), ("mdy", first))
    fits = [order for order, months in orders if (months <= 12).all()]
    if len(fits) == 2 and (first != second).any():
        fits = _that_go_on(parts[rows], of_day[rows.to_numpy()], fits)
    if len(fits) == 2 and (first != second).any():
        k = int(np.flatnonzero(rows.to_numpy())[np.argmax(first != second)])
        days = [pd.to_datetime(_iso_days(parts.iloc[[k]], o).iloc[0]).strftime("%-d %B %Y") for o in fits]
        raise InputError(f"{where(k)}: {texts.iloc[k]!r} may be {days[0]} or {days[1]}; {rules.remedy}")
    return fits[0] if fits else "dmy"  # which names the date that is none


def _that_go_on(parts: pd.DataFrame, of_day: Array, fits: list[Order]) -> list[Order]:
    """Orders by which a record that goes past midnight is shortest; all where it stays within a day."""
    spans = []
    for order in fits:
        days = pd.to_datetime(_iso_days(parts, order), format="%Y-%m-%d", utc=True, errors="coerce")
        spans.append(float(np.ptp(_unix(days) + of_day)))
    return [order for order, span in zip(fits, spans, strict=True) if span <= 2.0 * min(spans)]


def _iso_days(parts: pd.DataFrame, order: Order | None) -> "pd.Series[Any]":
    year, month, day = {None: ("a", "b", "c"), "dmy": ("c", "b", "a"), "mdy": ("c", "a", "b")}[order]
    years = parts[year].where(parts[year].str.len() != 2, "20" + parts[year])
    return years + "-" + parts[month].str.zfill(2) + "-" + parts[day].str.zfill(2)


def _zones(zones: "pd.Series[Any]", zone_h: float) -> Array:
    """How far the clock of each row is ahead of UTC [s]."""
    fields = zones.str.extract(r"^([+-])(\d{2}):?(\d{2})?$")
    ahead = 3600.0 * fields[1].fillna("0").astype(float) + 60.0 * fields[2].fillna("0").astype(float)
    signed = np.where(fields[0] == "-", -ahead, ahead)
    return np.where(zones.isna(), 3600.0 * zone_h, signed)


def _with_month_names(
    texts: "pd.Series[Any]", stated: "np.ndarray[Any, Any]", rules: DateRules, where: Callable[[int], str], odd: int
) -> Array:
    """Unix time of dates such as "1 May 2026 09:30"."""
    named = bool(re.search(r"[A-Za-z]{3}", texts.iloc[odd]))
    dates = pd.to_datetime(texts.where(stated), format="mixed", utc=True, errors="coerce") if named else None
    wrong = odd if dates is None else next(iter(np.flatnonzero(dates.isna() & stated)), None)
    if wrong is not None or dates is None:
        text = texts.iloc[int(wrong or 0)][:30]
        raise InputError(
            f"{where(int(wrong or 0))}: {text!r} is neither seconds nor a date such as 2026-05-01 09:30:00.5"
        )
    return _unix(dates) - 3600.0 * rules.zone_h
