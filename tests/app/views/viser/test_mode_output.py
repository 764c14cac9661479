"""A discrete mode is shown as a probability in what `nisus fold` prints."""

from app.cli.arguments import FoldCommand
from app.cli.fold import fold_twin
from app.twin.twin import load_twin


def test_fold_prints_the_probability_and_its_brier_score(capsys) -> None:
    assert fold_twin(FoldCommand("gripper_contact", duration=0.5)) == 0
    lines = capsys.readouterr().out.splitlines()
    (line,) = [line for line in lines if "probability of contact" in line]
    # Nothing is touched in the first half second, and the filter knows.
    assert "0.000 at the end" in line and "Brier score" in line
    assert not any("RMSE contact" in line for line in lines)


def test_only_a_mode_of_two_values_is_a_probability() -> None:
    model = load_twin("gripper_contact").model
    assert [model.label(name) for name in model.state_names[:2]] == ["probability of contact", "depth"]
    assert load_twin("motor_winding").model.label("temperature") == "temperature"
