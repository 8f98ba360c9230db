"""Every word that a result can hold is explained."""

import re

import pytest

from dielectric_jax.diagram import ENDS, LOSSES, NOT_DECIDED, NOT_LOCATED
from dielectric_jax.model import GLOSSARY, PARAMETERS, Outcome, PointKind, RampEvent, Regime, explain
from dielectric_jax.model.records import QUANTITIES
from dielectric_jax.numerics import Code
from dielectric_jax.rates.sweeping import RunOutcome, TimeRegime
from dielectric_jax.sweeps.variables import Answer

SHOWN = (PointKind.fold, PointKind.zero_voltage, PointKind.breakdown, PointKind.hoop_tension_loss, PointKind.slack)
WORDS = [
    *(member.name for of in (Regime, RampEvent, Outcome, Code, Answer, RunOutcome, TimeRegime) for member in of),
    *(kind.name for kind in (*SHOWN, PointKind.mode, PointKind.cusp)),
    *QUANTITIES,
    *PARAMETERS,
    *ENDS,
    *LOSSES.values(),
    NOT_DECIDED,
    NOT_LOCATED,
    *("window", "zero voltage", "too many jumps", "slack"),
    *("error_above_tolerance", "points_lost", "end_lost", "special_point_lost", "ends_slack"),
    *("jump", "creep_through", "instantaneous_fold", "fastest", "relaxed", "fresh", "at rest", "end of the protocol"),
]


@pytest.mark.parametrize("word", sorted(set(WORDS)))
def test_words_of_results_are_explained(word):
    text = explain(word)
    assert text == explain(word.replace("_", " ").upper()) and text.endswith(".") and len(text) > 15


def test_an_unknown_word_is_refused_with_those_that_resemble_it():
    with pytest.raises(ValueError, match=r"`word` must be .* but 'retruns' resembles returns"):
        explain("retruns")
    with pytest.raises(ValueError, match="resembles none"):
        explain("qqqqqqqq")


def test_meanings_are_sentences():
    assert all(re.fullmatch(r"[A-Z].*\.", text) for text in GLOSSARY.values())
