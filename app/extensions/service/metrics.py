"""The running twin for Prometheus, in base units. Extra `service`: `pip install 'nisus[service]'`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from starlette.responses import Response
from starlette.routing import BaseRoute

from app.engine.engine import Engine
from app.engine.outputs.state_message import state_message
from app.web.http import get, refusal
from estimators.errors import ConfigError
from estimators.track import HEALTH_NAMES, VERDICT_NAMES

if TYPE_CHECKING:
    from prometheus_client.core import Metric
    from prometheus_client.registry import Collector


class TwinCollector:
    """Metrics of one twin, made anew for each scrape."""

    def __init__(self, engine: Engine, *, states: bool) -> None:
        """`states`: also one series per state, which a large twin has thousands of."""
        self._engine, self._states = engine, states

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics (prometheus_client's protocol)."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        status, message = self._engine.status(), state_message(self._engine)

        def gauge(name: str, text: str, value: float | None) -> Metric:
            found = GaugeMetricFamily(f"nisus_{name}", text, labels=["twin"])
            if value is not None and np.isfinite(value):
                found.add_metric([message.twin], value)
            return found

        health = GaugeMetricFamily("nisus_health", "1 for the present health, else 0.", labels=["twin", "health"])
        for name in HEALTH_NAMES:
            health.add_metric([message.twin, name], float(name == message.health))
        yield health
        yield gauge("estimate_valid", "Whether all states are valid.", float(message.estimate_valid))
        yield gauge("inputs_valid", "Whether all inputs are valid.", float(message.inputs_valid))
        yield gauge("nis_ratio", "Mean NIS per degree of freedom of the last window, expected 1.", message.nis)
        yield gauge("nis_ratio_low", "Lower 95 % bound of nisus_nis_ratio.", status.nis.low / status.nis.dof)
        yield gauge("nis_ratio_high", "Upper 95 % bound of nisus_nis_ratio.", status.nis.high / status.nis.dof)
        yield gauge("state_age_seconds", "Since the last event arrived.", message.age_s)
        latency = None if status.latency_ms is None else status.latency_ms * 1e-3
        yield gauge("latency_p99_seconds", "From the arrival of a measurement to its estimate.", latency)
        yield gauge("episodes_open", "Fault episodes that last.", float(status.episodes_open))
        yield gauge("revision", "Increases when the past is estimated again.", float(message.revision))
        measurements = CounterMetricFamily(
            "nisus_measurements", "Measurements by what became of them.", labels=["twin", "sensor", "verdict"]
        )
        for sensor, counts in zip(self._engine.model.sensor_names, status.sensor_rows, strict=True):
            for verdict, count in zip(VERDICT_NAMES[1:], counts[1:], strict=True):
                measurements.add_metric([message.twin, sensor, verdict], float(count))
        yield measurements
        yield from self._published(message.twin)
        problems = CounterMetricFamily(
            "nisus_problems",
            "Reported problems: frames lost, wrong times, failures and others.",
            labels=["twin", "kind"],
        )
        for kind, count in self._engine.notices.counts().items():
            problems.add_metric([message.twin, kind], float(count))
        yield problems
        if self._states:
            labels = ["twin", "state", "unit"]
            mean = GaugeMetricFamily("nisus_state_mean", "Estimate of a valid state, in its unit.", labels=labels)
            std = GaugeMetricFamily("nisus_state_std", "Its standard deviation.", labels=labels)
            grades = GaugeMetricFamily(
                "nisus_state_grade", "1 for the present grade of a state.", labels=["twin", "state", "grade"]
            )
            for state in message.states:
                grades.add_metric([message.twin, state.name, state.grade], 1.0)
                for family, value in ((mean, state.value), (std, state.std)):
                    if value is not None:
                        family.add_metric([message.twin, state.name, state.unit], value)
            yield from (mean, std, grades)

    def _published(self, twin: str) -> Iterator[Metric]:
        """Yield metrics of outputs and receivers of alerts; of the ones that the twin has."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        found = {} if self._engine.published is None else self._engine.published.json()
        up = GaugeMetricFamily("nisus_output_up", "Whether an output reaches clients.", labels=["twin", "output"])
        for item in found.get("outputs", ()):
            up.add_metric([twin, item["name"]], float(item["connected"]))
        for item in found.get("receivers", ()):
            up.add_metric([twin, f"alerts to {item['name']}"], float(not item["failing"]))
        yield up
        labels = ["twin", "receiver", "outcome"]
        alerts = CounterMetricFamily("nisus_alerts", "Alerts by what became of them.", labels=labels)
        waiting = GaugeMetricFamily("nisus_alerts_waiting", "Alerts not yet delivered.", labels=labels[:2])
        for item in found.get("receivers", ()):
            waiting.add_metric([twin, item["name"]], float(item["waiting"]))
            for outcome in ("delivered", "dropped"):
                alerts.add_metric([twin, item["name"], outcome], float(item[outcome]))
        yield from (alerts, waiting)


def metrics_route(engine: Engine) -> BaseRoute:
    """Return the route of the metrics of a running twin."""

    def metrics(states: bool = False) -> Response:
        """Answer with metrics for Prometheus; `states` adds a series per state."""
        return exposed(TwinCollector(engine, states=states))

    return get("/metrics", metrics)


def exposed(collector: Collector) -> Response:
    """Answer with metrics, also of this process, in Prometheus's text format; 501 without its package."""
    try:
        from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, ProcessCollector, generate_latest
    except ModuleNotFoundError:
        return refusal(ConfigError("metrics need prometheus-client: pip install 'nisus[service]'"), 501)
    registry = CollectorRegistry()
    registry.register(collector)
    ProcessCollector(registry=registry)
    return Response(generate_latest(registry), media_type=CONTENT_TYPE_LATEST)
