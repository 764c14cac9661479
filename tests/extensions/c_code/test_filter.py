"""Exported C against the fold, compiled by the C compiler; single precision against a bound on its rounding errors."""

import json
import re
import subprocess

import numpy as np
import pytest

from app.cli.main import main
from app.extensions.c_code.filter import export_c
from app.twin.twin import load_twin
from estimators.errors import ConfigError
from tests.cases import cases
from tests.skips import program, recorded
from tests.support import error_of

WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")

SINGLE = 2.0**-24  # unit roundoff


@pytest.fixture(scope="module")
def compiler():
    """The C compiler."""
    return program("compiler")


def exported(name, duration=None, events=2000, **overrides):
    twin, log = recorded(name, overrides=overrides, duration=duration)
    return twin, log, export_c(twin.name, twin.estimator, twin.model, twin.tuning, log, events)


def compared(compiler, folder, found, real="double", bound=1e-12):
    """Compile and run the test of an export: its exit code; rows, errors of mean, std and NIS, wrong verdicts."""
    for name, text in found.files.items():
        (folder / name).write_text(text)
    sources = [name for name in found.files if name.endswith(".c")]
    subprocess.run([compiler, *WARNINGS, f"-DREAL={real}", *sources, "-lm", "-o", "test"], cwd=folder, check=True)
    vectors = next(name for name in found.files if name.endswith(".csv"))
    ended = subprocess.run(["./test", vectors, repr(float(bound))], cwd=folder, capture_output=True, text=True)
    return ended.returncode, [float(item) for item in re.findall(r"\d[\d.e+-]*", ended.stdout)]


@pytest.mark.parametrize(
    ("name", "duration", "overrides"),
    [
        ("motor_winding", None, {}),  # linear, no inputs
        ("motor_winding", None, {"estimator": "kf-steady"}),
        ("motor_can", 30.0, {}),  # inputs, three sensors, a Jacobian of its own, split steps
        ("motor_joint", 30.0, {}),  # a parameter as a state, held within its range
        ("battery_panasonic", 900.0, {}),  # considered parameters within ranges; a table, as branches
        ("uwb_rover_plaza", 60.0, {}),  # an angle, a covariance of the noise that depends on the state
        ("road_car", 20.0, {}),  # sensors of two rows, angles measured, a gate
    ],
)
def test_c_code_follows_the_fold(compiler, tmp_path, name, duration, overrides):
    _, _, found = exported(name, duration, **overrides)
    code, (rows, mean, std, nis, wrong) = compared(compiler, tmp_path, found)
    assert (code, rows, wrong) == (0, found.events, 0)
    assert found.events >= 100
    assert max(mean, std) <= 1e-12
    assert nis <= 1e-11  # a difference of two numbers of the size of y, divided by their spread


def test_a_measurement_beyond_the_gate_or_with_a_missing_row_or_with_its_own_variance(compiler, tmp_path):
    """The gate of road_car rejects; its vectors then hold each kind of answer."""
    _, _, found = exported("road_car", 60.0)
    table = np.loadtxt(found.files["road_car_vectors.csv"].splitlines(), delimiter=",")
    code, (*_, wrong) = compared(compiler, tmp_path, found)
    rows = int(re.search(r"ROWS = (\d+)", found.files["road_car.h"])[1])
    inputs = int(re.search(r"INPUTS = (\d+)", found.files["road_car.h"])[1])
    verdicts = table[:, 2 + max(rows, inputs) + rows]
    assert set(verdicts) >= {-1.0, 0.0, 1.0}
    assert (code, wrong) == (0, 0)


def test_a_wrong_vector_fails(compiler, tmp_path):
    _, _, found = exported("motor_winding")
    vectors = found.files["motor_winding_vectors.csv"].splitlines()
    cells = vectors[50].split(",")
    cells[6] = repr(float(cells[6]) * (1.0 + 1e-10))
    vectors[50] = ",".join(cells)
    found.files["motor_winding_vectors.csv"] = "\n".join(vectors) + "\n"
    assert compared(compiler, tmp_path, found)[0] == 1


class Sources:
    """Rounding errors made so far: bounds `at` their time, and the transition of each from then to now."""

    def __init__(self, n):
        self.moved, self.bounds = np.zeros((0, n, n)), []

    def made(self, bound):
        self.moved = np.concatenate([self.moved, np.eye(self.moved.shape[1])[None]])
        self.bounds.append(bound)

    def move(self, A):
        self.moved = A @ self.moved

    def of_vector(self):
        return sum(np.abs(M) @ b for M, b in zip(self.moved, self.bounds, strict=True))

    def of_matrix(self):
        return sum(np.abs(M) @ b @ np.abs(M).T for M, b in zip(self.moved, self.bounds, strict=True))


def test_single_precision_stays_within_the_bound_on_its_rounding_errors(compiler, tmp_path):
    """First-order bounds on the errors of x and P: each step's own, moved on by the filter's transition (I - K H) F.

    An operation of n terms errs by at most (n + 2) u times the sum of their magnitudes: Higham (2002), Accuracy and
    Stability of Numerical Algorithms, section 3.1. The longest chain is P Hᵀ, S, the gain, and two products of the
    Joseph form, of two terms each.
    """
    twin, _, found = exported("motor_winding")
    rows = np.loadtxt(found.files["motor_winding_vectors.csv"].splitlines(), delimiter=",")
    c = 12.0 * SINGLE
    x, P = twin.model.prior_mean.copy(), twin.model.prior_cov.copy()
    x_errors, P_errors = Sources(2), Sources(2)
    H, R, worst = np.array([[1.0, 0.0]]), twin.tuning.r[0], 0.0
    for _, dt, y, _, verdict, *_ in rows:
        F, Q = np.array([[1.0, dt], [0.0, 1.0]]), np.diag(twin.tuning.q * dt)
        x_errors.move(F)
        P_errors.move(F)
        x_errors.made(c * np.abs(F) @ np.abs(x))
        P_errors.made(c * (np.abs(F) @ np.abs(P) @ np.abs(F).T + Q))
        x, P = F @ x, F @ P @ F.T + Q
        if verdict == 0.0:  # not a lost sample
            S = (H @ P @ H.T).item() + R
            K, nu, error = P @ H.T / S, y - (H @ x).item(), P_errors.of_matrix()
            of_gain = (error @ H.T + np.abs(K) * (H @ error @ H.T)) / S + c * np.abs(K)
            A = np.eye(2) - K @ H
            x_errors.move(A)
            P_errors.move(A)  # errors of an optimal gain have no part in P, to first order
            x_errors.made(of_gain[:, 0] * abs(nu) + c * (np.abs(x) + np.abs(K[:, 0]) * (abs(y) + abs(nu))))
            P_errors.made(c * (np.abs(A) @ np.abs(P) @ np.abs(A).T + np.abs(K) * R @ np.abs(K).T))
            x, P = x + K[:, 0] * nu, A @ P @ A.T + K * R @ K.T
        std = np.sqrt(np.diag(P))
        worst = max(worst, (x_errors.of_vector() / (np.abs(x) + std)).max())
        worst = max(worst, (0.5 * np.diag(P_errors.of_matrix()) / std**2).max())
    code, (_, mean, std, _, wrong) = compared(compiler, tmp_path, found, "float", worst)
    assert (code, wrong) == (0, 0)
    assert SINGLE < max(mean, std) <= worst < 0.01


@cases(__file__, "unwritten.csv")
def test_what_cannot_be_written_says_why(name, overrides, message):
    twin = load_twin(name, overrides=json.loads(overrides))
    text = error_of(ConfigError, export_c, twin.name, twin.estimator, twin.model, twin.tuning, None, 1)
    assert text.startswith(f"{name}: {message}")


def test_command(compiler, tmp_path, capsys):
    out = tmp_path / "firmware"
    assert main(["export", "motor_winding", "--c", "--out", str(out), "--events", "20"]) == 0
    printed = capsys.readouterr().out.splitlines()
    names = ["motor_winding.h", "motor_winding.c", "motor_winding_test.c", "motor_winding_vectors.csv"]
    assert printed[:4] == [str(out / name) for name in names]
    assert printed[4].startswith("kf, 2 states: 24 bytes of memory in single precision")
    assert printed[5] == "20 events in the test; it ends early: --events 20"
    ended = subprocess.run(printed[6], shell=True, cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 0
    assert ended.stdout.startswith("20 rows; ")
    (tmp_path / "file").write_text("")
    assert main(["export", "motor_winding", "--c", "--out", str(tmp_path / "file")]) == 2
    assert "name a folder to write to" in capsys.readouterr().err
    assert main(["export", "motor_winding"]) == 2
    assert "--c writes C99" in capsys.readouterr().err
