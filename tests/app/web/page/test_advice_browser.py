"""Advice on the page: of a linear model under another filter it is the Kalman filter, which applies itself; undone."""

import pytest

from tests.app.web.page.browsed import running, settled
from tests.waiting import wait_for

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
    wait_for(lambda: apply.count() == 1)
    card = page.locator("#advice-panel article.first")
    assert card.locator("h3").inner_text().startswith("Kalman filter")
    assert "The model is linear; a Kalman filter is exact." in card.inner_text()
    # A card a finding, in words; those that decided are marked, and the figures are behind a line.
    claims = page.locator("#advice-panel article[data-key]")
    assert claims.count() >= 4
    linear = page.locator('#advice-panel [data-key="linear"]')
    assert linear.locator("h3").inner_text() == "The model is linear; a Kalman filter is exact."
    figures = linear.locator("details p")
    assert figures.is_hidden()
    linear.locator("summary").click()
    assert figures.inner_text().startswith("Are f and h linear? yes: ") and "limit 1e-09" in figures.inner_text()
    assert page.locator('#advice-panel [data-decides="true"]').count() >= 1

    apply.click()
    settled(engine, 1)
    assert engine.estimator == "kf" and engine.revisions.runs[-1].number == 1
    wait_for(lambda: "another runs now" in page.locator("#advice-panel").inner_text())
    # Wherever the focus went while it was measured.
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Escape")
    page.locator("#advice-panel").wait_for(state="hidden")
    page.locator("body").press("u")
    settled(engine, 2)
    assert engine.estimator == "ukf"
