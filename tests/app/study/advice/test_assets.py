"""The advice on eight assets of which the right answer is known, as it is known how they were made."""

import numpy as np
import pytest

from app.study.advice.measured import UNTOLD, Exclusion, Measured, without_faults
from app.study.advice.verdict import Advice, advise, changed, details, finding, lines
from app.twin.twin import load_twin
from config.old_names import rewrite
from estimators.diagnostics.episodes import Episode
from estimators.log import READING
from estimators.registry import find_entry
from tests.app.study.advice import recordings
from tests.app.study.advice.recordings import write
from tests.skips import recorded


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """The advice on an asset, each asked for once."""
    folder, known = tmp_path_factory.mktemp("assets"), {}

    def ask(name: str, model: str, make, sensor: str, estimator: str = "kf") -> Advice:
        if name not in known:
            known[name] = advise(Measured(*recorded(write(folder, name, model, estimator, make, sensor))))
        return known[name]

    return ask


def test_linear_and_regular_takes_a_fixed_gain(told):
    found = told("linear", "LINEAR", recordings.linear, "rail")
    assert (found.estimator, found.because) == ("kf-steady", ("linear", "steady"))
    assert found.options == {"period": 1.0}
    assert found.claim("linear").figure < 1e-9 and found.claim("steady").figure <= 0.25
    assert found.claim("consistent").answer == "yes"


def test_mildly_nonlinear_takes_the_ekf(told):
    found = told("mild", "MILD", recordings.mild, "gauge", "ekf")
    assert (found.estimator, found.because) == ("ekf", ("linear", "peaks", "curvature"))
    claim = found.claim("curvature")
    assert claim.answer == "no" and 1e-9 < claim.figure < claim.threshold == 0.25
    # In words for engineers; the figures are details.
    assert finding(claim) == "Effectively linear; EKF is sufficient"
    assert finding(found.claim("linear")) == "Nonlinear, with a negligible effect on the estimate"
    assert found.reasons == [finding(found.claim(key)) for key in ("linear", "peaks", "curvature")]
    assert not any(letter.isdigit() for text in found.reasons for letter in text)
    assert details(claim).startswith(f"{claim.figure:.3g} σ between ekf and ukf (95th percentile), limit 0.25; ")


def test_strongly_nonlinear_takes_the_ukf(told):
    found = told("strong", "STRONG", recordings.strong, "glow", "ekf")
    assert found.estimator == "sr-ukf" and found.because[:3] == ("linear", "peaks", "curvature")
    claim = found.claim("curvature")
    assert claim.answer == "yes" and claim.figure > claim.threshold
    assert found.claim("peaks").answer == "no"


def test_two_peaks_take_particles(told):
    found = told("peaks", "PEAKS", recordings.peaks, "distance", "ekf")
    assert find_entry(found.estimator).family == "particle" and found.because == ("linear", "peaks")
    claim = found.claim("peaks")
    # x and -x explain every reading alike, and the prior is symmetric.
    assert claim.answer == "yes" and claim.figure > 0.5


def test_heavy_tails_take_weights_and_no_particles(told):
    found = told("tails", "LINEAR", recordings.tails, "rail")
    assert found.estimator == "kf" and found.because[-1] == "tails"
    assert found.options["robust"] == 2.0 and 4.0 < found.options["dof"] < 10.0
    claim = found.claim("tails")
    # Of a mixture with variances 1 and 100, 14 to 1: 3 E s⁴ / (E s²)² - 3, were the reading all of the innovation.
    share = 1 / 15
    kurtosis = 3 * (1 - share + share * 1e4) / (1 - share + share * 100) ** 2 - 3
    assert claim.threshold < claim.figure < 1.5 * kurtosis
    # To two figures, as one more differs once innovations are weighted.
    assert found.options["dof"] == float(f"{4 + 6 / claim.figure:.2g}")


def test_a_field_takes_a_localised_ensemble(told):
    found = told("field", "FIELD", recordings.field, "probes", "ensrf")
    assert find_entry(found.estimator).family == "ensemble" and found.because[0] == "size"
    assert found.claim("size").figure == 1200
    assert 0 < found.options["radius"] < 1200 and found.options["members"] <= 80 and found.options["inflation"] >= 1


def test_what_nothing_tells_of_is_named(told):
    found = told("unseen", "UNSEEN", recordings.linear, "rail")
    claim = found.claim("observed")
    assert claim.answer == "no" and claim.figure == pytest.approx(1.0, abs=1e-3)
    assert "load" in claim.remedy and "speed" not in claim.remedy
    assert (found.estimator, found.because) == ("kf", ("observed", "linear"))
    assert claim.remedy in found.remedies


def test_options_of_the_twin_are_kept(tmp_path):
    """With which everything was measured; the lines took them away, and the twin was no longer consistent."""
    adaptive = "{name: kf, options: {adapt: Q, memory: 300}}"
    twin, log = recorded(path := write(tmp_path, "varying", "VARYING", adaptive, recordings.varying, "probe"))
    found = advise(Measured(twin, log))
    assert found.options == twin.options_of("kf") == {"adapt": 2.0, "memory": 300.0}
    rewrite(path, lambda text: changed(text, lines(found)))
    assert load_twin(path).options_of("kf") == found.options


def test_time_varying_takes_a_gain_that_follows(told):
    found = told("varying", "VARYING", recordings.varying, "probe")
    assert (found.estimator, found.because) == ("kf", ("linear", "steady"))
    assert "varies with its inputs" in found.claim("steady").reason


def test_an_error_that_lasts_is_found_with_its_size_and_time(told, tmp_path):
    found = told("erring", "STILL", recordings.erring, "float")
    before, after = found.claim("consistent"), found.claim("lasting")
    assert before.answer == "no" and "correlated" in before.reason
    assert after.answer == "yes" and after.figure < after.threshold
    assert list(found.sections) == ["sensors.float"]
    entry = found.sections["sensors.float"]
    # 160 times as long as it lasts: logarithms of its time and variance are off by √(2 / 160) = 0.11 at best.
    assert float(entry["error"]["correlation_time"].removesuffix(" s")) == pytest.approx(recordings.LASTS, rel=0.5)
    assert entry["error"]["variance"] == pytest.approx(recordings.ERROR**2, rel=0.5)
    assert entry["variance"] == pytest.approx(recordings.WHITE**2, rel=0.3)
    # The lines as they are put in make a twin that is consistent.
    path = write(tmp_path, "erring", "STILL", "kf", recordings.erring, "float")
    assert rewrite(path, lambda text: changed(text, lines(found), found.sections)) is not None
    twin, log = recorded(path)
    assert "float_error" in twin.model.state_names
    again = advise(Measured(twin, log))
    assert again.claim("consistent").answer == "yes" and again.claim("lasting") is None


@pytest.mark.parametrize("number", [1, 2])
def test_of_few_readings_nothing_is_said_of_the_innovations(tmp_path, number):
    """Two of which the second is far off bear no band out, and tell none wrong either."""
    twin, log = recorded(
        write(tmp_path, "few", "LINEAR", "kf", recordings.linear, "rail"), duration=0.5 if number == 1 else 1.5
    )
    assert int((log.events.kind == READING).sum()) == number
    found = advise(Measured(twin, log)).claim("consistent")
    assert found.answer == UNTOLD and found.remedy == ""


def test_faults_of_a_sensor_are_left_out(tmp_path, nisus):
    path = write(tmp_path, "stuck", "LINEAR", "kf", recordings.stuck, "rail")
    twin, log = recorded(path)
    clean, excluded = without_faults(twin, log)
    begin, end = recordings.STUCK.start, recordings.STUCK.stop
    assert excluded == (Exclusion("rail", "stuck", begin, end - 1, end - begin),)
    assert np.flatnonzero(np.isnan(clean.events.value[:, 0])).tolist() == list(range(begin, end))
    page = nisus("advise", path).words
    assert "Excluded: faults of sensors rail, 200 s to 259 s: stuck (60 readings)" in page
    assert "Bands are right within a quarter, and innovations are hardly correlated" in page


def test_what_lasts_for_most_of_the_log_is_no_fault(tmp_path):
    twin, log = recorded(write(tmp_path, "linear", "LINEAR", "kf", recordings.linear, "rail"))

    def shifted(start, end):
        return Episode(start, end, "rail", "shifted", 2.0, 1.5, 2.5, "σ", "")

    clean, excluded = without_faults(twin, log, [shifted(100.0, 109.0), shifted(400.0, None)])
    assert [item.readings for item in excluded] == [10, recordings.N - 400]
    assert np.isnan(clean.events.value[:, 0]).sum() == 10 + recordings.N - 400
    whole, excluded = without_faults(twin, log, [shifted(100.0, None)])
    assert excluded == () and whole is log
