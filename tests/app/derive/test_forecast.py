"""What if, asked of a running twin: against the closed form; what is refused; and that nothing is disturbed."""

import asyncio
import json
import threading
from dataclasses import replace

import numpy as np
import pytest

from app.derive.forecast import ForecastQuestion, Forecasts, forecast_json, recorded
from app.engine.engine import Engine
from app.web.http import OneAtATime, parse
from app.web.server import PageServer
from estimators.errors import ConfigError
from estimators.forecast import Crossing, Forecast, forecast
from estimators.log import INPUT, READING, Events
from estimators.models import MODELS
from tests.app.scripted import MODEL, Scripted, pull_all, readings, twin
from tests.app.served import SECRET, Client
from tests.cases import cases
from tests.support import SECOND, error_of


def running(n=200):
    """A twin of the winding's temperature and rate, which has had readings every half second."""
    engine = Engine(twin(), lambda report: Scripted())
    y = 40.0 + np.random.default_rng(2).normal(0, 2, n)
    if n:
        engine._accept([readings(0.5 * np.arange(1, n + 1), y)])
    return engine


def ask(engine, **body):
    return json.loads(json.dumps(Forecasts(engine).compute(ForecastQuestion(**body)), allow_nan=False))


def test_the_answer_is_the_closed_form_in_steps_of_the_readings():
    engine = running()
    said = ask(engine, horizon=30.0, limits={"temperature": 45.0})
    belief = engine.belief()
    F, Q = np.array([[1, 0.5], [0, 1]]), np.diag([0.01, 0.001]) * 0.5
    x, P = belief.mean, belief.cov
    means, stds = [x], [np.sqrt(np.diag(P))]
    for _ in range(60):
        x, P = F @ x, F @ P @ F.T + Q
        means.append(x)
        stds.append(np.sqrt(np.diag(P)))
    assert said["step"] == pytest.approx(0.5) and said["now"] == 100.0 and said["members"] == 0
    np.testing.assert_allclose(said["t"], 0.5 * np.arange(61))
    means, stds = np.array(means), np.array(stds)
    for j, name in enumerate(MODEL.state_names):
        state = said["states"][name]
        # Told with digits down to a hundredth of σ at least.
        assert np.all(np.abs(np.array(state["mean"]) - means[:, j]) < 0.01 * stds[:, j])
        assert np.all(np.abs(np.array(state["upper2"]) - means[:, j] - 2 * stds[:, j]) < 0.02 * stds[:, j])
        assert np.all(np.abs(np.array(state["lower1"]) - means[:, j] + stds[:, j]) < 0.02 * stds[:, j])
    limit = said["limits"]["temperature"]
    assert limit["above"] and limit["overall"] == max(limit["probability"])


def test_a_place_on_the_earth_is_told_to_a_hundredth_of_its_deviation():
    engine = running()
    here = engine.here()
    std = np.full((3, 2), 0.02)
    mean = np.array([[4_123_456.789, 0.0], [4_123_457.123, 0.0], [4_123_457.456, 0.0]])
    bands = mean[:, None] + np.array([-2, -1, 1, 2])[None, :, None] * std[:, None]
    said = forecast_json(MODEL, here, Forecast(np.arange(3.0), mean, std, bands, 0, ()), ())
    np.testing.assert_allclose(said["states"]["temperature"]["mean"], mean[:, 0], rtol=0, atol=2e-4)
    np.testing.assert_allclose(said["states"]["rate"]["upper2"], 0.04)


def test_a_forecast_ends_where_it_leaves_the_physical_limits():
    mean = np.array([[1.0, 0.0], [0.4, 0.0], [-0.1, 0.0], [-0.7, 0.0], [-1.2, 0.0]])
    bands = mean[:, None] + np.array([-0.5, -0.25, 0.25, 0.5])[:, None]
    model = replace(MODEL, states=(replace(MODEL.states[0], limits=(0.0, np.inf)), MODEL.states[1]))
    found = Forecast(np.arange(5.0), mean, mean, bands, 0, (Crossing("temperature", 0.2, False, np.arange(5) / 5),))
    said = forecast_json(model, running().here(), found, ())
    shown = [said["states"]["temperature"][name] for name in ("lower2", "mean", "upper1", "upper2")]
    expected = [[0.5, 0, 0, 0], [1, 0.4, 0, 0], [1.25, 0.65, 0.15, 0], [1.5, 0.9, 0.4, 0]]
    np.testing.assert_allclose(shown, expected, atol=1e-9)
    assert said["method"].endswith("; the forecast ends after 3 s, when temperature leaves its physical limits")
    assert (said["t"], said["limits"]["temperature"]["overall"]) == ([0, 1, 2, 3], 0.6)
    with pytest.raises(ConfigError, match="forecast: temperature is impossible now"):
        forecast_json(model, running().here(), found._replace(bands=bands - 2.0), ())


def test_inputs_hold_from_the_time_that_is_asked_for():
    engine = Engine(twin(model=MODELS["motor_drive"], estimator="ekf"), lambda report: Scripted())
    times = np.arange(1, 40) * SECOND
    y = np.full((39, MODELS["motor_drive"].width), np.nan)
    y[:, 0] = 45.0
    engine._accept([Events.alike(READING, times, y)])
    as_now, later, at_once = (
        ask(engine, horizon=60.0, inputs=inputs) for inputs in ({}, {"i_q": [[30.0, 400.0]]}, {"i_q": 400.0})
    )
    winding = [np.array(said["states"]["winding"]["mean"]) for said in (as_now, later, at_once)]
    before = np.array(later["t"]) <= 30.0
    np.testing.assert_array_equal(winding[1][before], winding[0][before])
    assert np.all(winding[1][~before] > winding[0][~before]) and np.all(winding[2][1:] > winding[0][1:])
    assert as_now["inputs"]["i_q"] == 0.0


def driven(*, changes):
    """A drive that was read every second for 40 s, and whose current changed meanwhile, by (seconds, A)."""
    model = MODELS["motor_drive"]
    engine = Engine(twin(model=model, estimator="ekf"), lambda report: Scripted())
    read = np.arange(1, 41) * SECOND
    turned = np.array([round(seconds * SECOND) for seconds, _ in changes], np.int64)
    t = np.concatenate((read, turned))
    kind = np.repeat(np.array([READING, INPUT], np.int8), (read.size, turned.size))
    value = np.full((t.size, model.width), np.nan)
    value[: read.size, 0] = 45.0
    value[read.size :, model.input_names.index("i_q")] = [current for _, current in changes]
    order = np.argsort(t)
    engine._accept([Events(t[order], t[order], kind[order], np.zeros(t.size, np.int32), value[order])])
    return engine


def test_what_was_recorded_of_an_input_is_repeated():
    engine = driven(changes=[(5.0, 100.0), (15.0, 300.0), (38.5, 50.0)])
    # The last 30 s, 10 to 40: 100 A held at first.
    again = ask(engine, horizon=30.0, inputs={"i_q": "repeat"})
    expected = [[0.0, 100.0], [5.0, 300.0], [28.5, 50.0]]
    assert again["chosen"] == {"i_q": {"t": [t for t, _ in expected], "value": [value for _, value in expected]}}
    told = ask(engine, horizon=30.0, inputs={"i_q": expected})
    assert again["states"] == told["states"] and again["states"] != ask(engine, horizon=30.0)["states"]
    # The log is 39 s long: what is beyond comes once more, and 50 A hold until the first change of it.
    longer = ask(engine, horizon=60.0, inputs={"i_q": "repeat"})["chosen"]["i_q"]
    assert longer == {"t": [4.0, 14.0, 37.5, 43.0, 53.0], "value": [100.0, 300.0, 50.0, 100.0, 300.0]}
    # Of an input that never changed there is nothing to repeat.
    assert ask(engine, horizon=30.0, inputs={"i_d": "repeat"})["chosen"] == {}
    with pytest.raises(ConfigError, match="i_q changed 3 times in 39 s, too often to be repeated for 1e"):
        recorded(engine, ["i_q"], 40 * SECOND, 1e6)


def test_nothing_of_the_running_twin_changes():
    engine, other = running(), running()
    ask(engine, horizon=60.0)
    more = readings(101.0 + np.arange(50), np.full(50, 41.0))
    for each in (engine, other):
        each._accept([more])
    np.testing.assert_array_equal(pull_all(engine).track.mean, pull_all(other).track.mean)


@cases(__file__, "refused_forecasts.csv")
def test_what_cannot_be_asked_is_refused_in_one_line(body, reason):
    body = json.loads(body)
    assert reason in error_of(ConfigError, lambda: parse(ForecastQuestion, body, "it").check(MODELS["motor_drive"]))


def test_a_forecast_needs_measurements_and_has_a_longest_horizon():
    engine = running()
    with pytest.raises(ConfigError, match=r"it may be 1e\+04 s at most"):
        ask(engine, horizon=1e6)
    with pytest.raises(ConfigError, match="no reading has come yet"):
        ask(running(0), horizon=1.0)


@pytest.mark.parametrize("lost", [1e60, np.nan])
def test_a_future_without_numbers_is_said_and_has_no_probability(monkeypatch, lost):
    engine = running()

    def running_away(*arguments, **options):
        found = forecast(*arguments, **options)
        found.mean[4:, 0] = lost
        return found

    monkeypatch.setattr("app.derive.forecast.forecast", running_away)
    with pytest.raises(ConfigError, match=r"forecast: 2 s from now a state is beyond 1e\+50, or no number"):
        ask(engine, horizon=10.0)


def test_the_page_asks_by_post(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("app.web.server.viewer_assets", lambda progress: tmp_path)
    server = PageServer(running(), port=0, viser_port=None, secret=SECRET)
    server.start()
    try:
        client = Client(server)
        answer = client.post("/api/forecast", {"horizon": 10, "limits": {"temperature": 50}})
        assert answer.status == 200 and len(json.loads(answer.text)["states"]["rate"]["mean"]) == 21
        refused = client.post("/api/forecast", {"horizon": 10, "limits": {"pressure": 50}})
        assert refused.status == 400 and "pressure" in json.loads(refused.text)["error"]
        assert client.post("/api/forecast", b"{").status == 400
    finally:
        server.stop()


def test_a_question_waits_for_the_one_before_it_and_not_for_ever(monkeypatch):
    monkeypatch.setattr("app.web.http.QUEUE_TIMEOUT_S", 0.01)
    go_on, under_way = threading.Event(), []

    def slow():
        under_way.append(1)
        go_on.wait()
        return len(under_way)

    async def ask():
        line = OneAtATime("forecast")
        first = asyncio.create_task(line(slow))
        while not under_way:
            await asyncio.sleep(0)
        with pytest.raises(ConfigError, match="forecast: another one is under way; ask again"):
            await line(slow)
        go_on.set()
        return await first, await line(slow)

    assert asyncio.run(ask()) == (1, 2)


def test_what_goes_wrong_in_the_thread_is_told_to_who_asked():
    def wrong():
        assert threading.current_thread().daemon  # a process that ends does not wait for it
        raise ZeroDivisionError("in the model")

    with pytest.raises(ZeroDivisionError, match="in the model"):
        asyncio.run(OneAtATime("forecast")(wrong))
