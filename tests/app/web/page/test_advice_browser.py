"""Advice on the page: of a linear model under another filter it is the Kalman filter, which applies itself; undone."""

import pytest

from tests.app.scripted import wait_for
from tests.app.web.page.browsed import PATIENCE, running, settled

pytestmark = pytest.mark.browser


@pytest.fixture
def session():
    with running("motor_winding", **{"estimator": "ukf"}) as session:
        yield session


def test_a_linear_model_is_told_its_filter_which_applies_itself(page, session):
    engine = session.engine
    assert engine.estimator == "ukf"
    page.locator("#advise").click()
    page.locator("#advice-panel").get_by_text("nothing measured yet").wait_for()
    page.locator("#advice-begin").click()
    apply = page.locator("#advice-apply")
    wait_for(lambda: apply.count() == 1, PATIENCE)
    card = page.locator("#advice-panel article.first")
    assert card.locator("h3").inner_text().startswith("Kalman filter")
    assert "because f and h are linear" in card.inner_text()
    # A card a claim; those that decided are marked, and each has its answer.
    claims = page.locator("#advice-panel article:not(.first)")
    assert claims.count() >= 4
    assert "linear" in claims.locator("h3").all_inner_texts()[0] + claims.locator("h3").all_inner_texts()[1]
    assert page.locator('#advice-panel [data-decides="true"]').count() >= 1

    apply.click()
    settled(engine, 1)
    assert engine.estimator == "kf" and engine.revisions.runs[-1].number == 1
    wait_for(lambda: "another runs now" in page.locator("#advice-panel").inner_text(), PATIENCE)
    # Wherever the focus went while it was measured.
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Escape")
    page.locator("#advice-panel").wait_for(state="hidden")
    page.locator("body").press("u")
    settled(engine, 2)
    assert engine.estimator == "ukf"
