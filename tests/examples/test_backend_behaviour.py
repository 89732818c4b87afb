"""The measurements of docs/backends-behaviour.md, of one solver and of one that is missing."""

import pytest

from examples.studies import backend_behaviour

FREE = "QPs without rows"


@pytest.mark.parametrize("name", ["quadprog", "daqp"])
def test_a_solver_answers_every_question(name):
    found = backend_behaviour.measured(name)
    assert list(found) == list(backend_behaviour.PARTS)
    assert not any("" in part for part in found.values())  # a part that failed
    assert found["Reading"]["one ulp from symmetric"] == "right"
    for title, entry in found["Hard problems"].items():
        own = entry.partition(" / ")[2]
        assert own == "0" or float(own) < 1e-6, (title, entry)
    # A dual active set method is exact without rows, and gives up where there is no solution.
    assert found["Little to hold on to"][FREE] == "40 of 40 right"
    assert found["Little to hold on to"]["infeasible"] == "not found, x None"


def test_the_page_names_what_is_missing():
    solver = {title: {"a": "1"} for title in backend_behaviour.PARTS}
    text = "\n".join(backend_behaviour.page({"daqp": solver, "sip": None}, {"daqp": "hello"}))
    assert text.count("| sip | not installed |") == len(backend_behaviour.PARTS)
    assert "daqp prints `hello`" in text
