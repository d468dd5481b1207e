"""The newest state as Prometheus metrics."""

import math
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from rovgraph.web.broadcast import Broadcast
from rovgraph.web.track import ellipse_sd

STATES = ("ok", "silent", "frozen", "no lock", "rejected")
VERDICTS = ("trusted", "doubtful", "wrong")


class Metrics:
    """Collects what `/metrics` answers.

    Parameters
    ----------
    broadcast : with the view
    """

    def __init__(self, broadcast: Broadcast) -> None:
        self._broadcast = broadcast
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(self)

    def text(self) -> bytes:
        """In Prometheus's text format."""
        return generate_latest(self._registry)

    def collect(self) -> Iterator[Metric]:
        """All metrics, as the client library asks for them."""
        yield GaugeMetricFamily("rovgraph_pages", "Pages that watch.", self._broadcast.pages)
        yield CounterMetricFamily("rovgraph_pages_dropped", "Pages that did not read.", self._broadcast.dropped)
        s = self._broadcast.view.newest
        if s is None:
            return
        for name, about, value in (
            ("time_seconds", "Time of the newest solution, by the estimate's clock.", s.time),
            ("position_sd_metres", "Standard deviation along the longer axis of the ellipse.", ellipse_sd(s)),
            ("depth_metres", "Depth, positive down.", float(s.position[2])),
            ("heading_degrees", "Heading, clockwise from north.", math.degrees(float(s.rpy[2])) % 360.0),
            ("heading_sd_degrees", "Its standard deviation.", math.degrees(float(s.rpy_sd[2]))),
            ("distance_metres", "Distance travelled.", s.distance),
            ("predicted_seconds", "How far the IMU alone carried the solution.", s.predicted_s),
            ("update_seconds", "Time that the newest update of the filter took.", s.update_s),
        ):
            yield GaugeMetricFamily(f"rovgraph_{name}", about, value)
        if s.latency_s is not None:
            yield GaugeMetricFamily("rovgraph_latency_seconds", "From measurement to solution.", s.latency_s)
        yield _one_of("rovgraph_verdict", "1 for the verdict of the estimate.", "verdict", VERDICTS, {"": s.verdict})
        states = {name: health.state for name, health in s.sensors.items()}
        yield _one_of("rovgraph_sensor_state", "1 for the state of each sensor.", "state", STATES, states)
        age = GaugeMetricFamily("rovgraph_sensor_age_seconds", "Since its last measurement.", labels=["sensor"])
        count = CounterMetricFamily("rovgraph_measurements", "Measurements met.", labels=["sensor", "outcome"])
        for name, health in s.sensors.items():
            age.add_metric([name], health.age)
            count.add_metric([name, "used"], health.used)
            count.add_metric([name, "rejected"], health.rejected)
        yield from (age, count)


def _one_of(name: str, about: str, label: str, values: tuple[str, ...], of: dict[str, str]) -> Metric:
    """1 for what it is and 0 for what it is not, as Prometheus has states."""
    named = list(of) != [""]
    metric = GaugeMetricFamily(name, about, labels=["sensor", label] if named else [label])
    for sensor, now in of.items():
        for value in values:
            metric.add_metric([sensor, value] if named else [value], float(value == now))
    return metric
