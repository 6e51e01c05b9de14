"""What a page with the right cookie could send: possible actions are solved before they are stored, others are not."""

from __future__ import annotations

import json
from functools import partial
from typing import Any

import pytest

pytest.importorskip("starlette", reason="the extra 'measure' is not installed")

from hostile_requests import check
from ortho_measure.journal import REST, Journal
from ortho_measure.project import Project
from ortho_measure.session import Session

from ortho_pipeline.errors import InputError

GROUND = [33.35, 37.25, 900.0]
MARK = {"id": "A", "image": [400.0, 500.0], "ground": GROUND, "ground_from": "reference"}
IMPOSSIBLE: tuple[dict[str, Any], ...] = (
    {"do": []}, {"do": {}}, {"do": None}, {"do": "undo", "more": 1}, {"do": "remove", "id": []},
    {"do": "put", "mark": {"id": "A", "role": "tie", "rays": {"scene": {"image": [1, 2]}, "b": {"image": [1, 2]}}}},
    {"do": "put", "mark": {**MARK, "role": "tie"}}, {"do": "put", "mark": {**MARK, "group": 2**63 - 1}},
    {"do": "put", "mark": {**MARK, "covariance": [1e200, 1e200, 0.0]}},
    {"do": "put", "mark": {**MARK, "covariance": [1e-200, 1e-200, 0.0]}},
    {"do": "put", "mark": {**MARK, "covariance": [0.1, 0.2, 1e200]}},
    {"do": "put", "mark": {**MARK, "ground": [33.35, 900.0, 900.0]}}, {"do": "correct", "correction": []},
)  # fmt: skip


def test_an_impossible_action_is_refused_and_not_stored(projects: list[Any]) -> None:
    session: Project = projects[0]()
    session.act({"do": "put", "mark": {**MARK, "id": "B", "image": [1.0, 2.0], "ground": [33.34, 37.24, 900.0]}})
    before = session.journal.path.read_bytes(), session.marks
    for action in IMPOSSIBLE:
        with pytest.raises(InputError):
            session.act(action)
        assert (session.journal.path.read_bytes(), session.marks) == before, action
    session.close()
    projects[0]().close()


def test_what_cannot_be_solved_or_shown_is_not_stored(projects: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    session: Session = projects[0]()
    before = session.journal.path.read_bytes(), session.marks, session.solution, session.rendered
    for name in ("_solve", "_figures"):
        with monkeypatch.context() as broken:
            broken.setattr(Session, name, lambda self: 1 // 0)
            with pytest.raises(ZeroDivisionError):
                session.act({"do": "put", "mark": MARK})
        assert (session.journal.path.read_bytes(), session.marks, session.solution, session.rendered) == before
    assert [mark["id"] for mark in session.act({"do": "put", "mark": MARK})["marks"]] == ["A"]
    session.close()


@pytest.mark.parametrize("action", [IMPOSSIBLE[0], IMPOSSIBLE[5], IMPOSSIBLE[10], IMPOSSIBLE[11]])
def test_a_journal_opens_up_to_an_impossible_action(projects: list[Any], action: dict[str, Any]) -> None:
    journal_of_both(projects[0], action)
    session: Project = projects[0]()
    assert list(session.marks.by_id) == ["A"]
    assert "action 3" in session.stopped
    # What follows is kept, and the journal goes on where it ends now.
    rest = session.journal.path.with_name(session.journal.path.name + REST)
    assert [json.loads(line)["action"].get("do") for line in rest.read_text().splitlines()] == [action["do"], "put"]
    session.act({"do": "put", "mark": {**MARK, "id": "D", "image": [9.0, 9.0], "ground": [33.34, 37.26, 900.0]}})
    session.close()
    again: Project = projects[0]()
    assert (list(again.marks.by_id), again.stopped) == (["A", "D"], "")
    again.close()


def journal_of_both(opening: partial[Project], action: dict[str, Any]) -> None:
    """Write a journal with an action in its middle that a program without checks has let through."""
    session = opening()
    session.act({"do": "put", "mark": MARK})
    session.close()
    journal = Journal(session.journal.path)
    journal.append({**action, "at": "2026-01-01T00:00:00Z"})
    journal.append({"do": "put", "mark": {**MARK, "id": "C", "image": [5.0, 5.0], "ground": [33.36, 37.26, 900.0]}})
    journal.close()


def test_who_only_reads_stops_there_too_and_changes_nothing(projects: list[Any]) -> None:
    journal_of_both(projects[0], {"do": []})
    path = projects[0].args[1].with_name("one.geojson.journal")
    writer = Journal(path)
    before = path.read_bytes()
    reader: Project = projects[0]()
    assert [mark["id"] for mark in reader.state()["marks"]] == ["A"]
    assert "action 3" in reader.stopped
    assert path.read_bytes() == before
    assert not path.with_name(path.name + REST).exists()
    reader.close()
    writer.close()


@pytest.mark.parametrize("number", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_hostile_requests_are_answered_and_what_they_store_opens(projects: list[Any], number: int) -> None:
    answered = check(projects[number], 120, 11 + number, 120)
    assert answered[200] > 20
    assert answered[400] > 20


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_ten_thousand_hostile_requests(projects: list[Any], number: int) -> None:
    assert check(projects[number], 10_000, 1 + number, 500).total() == 10_000
