"""A file that is wrong by far more than slopes show is found out by its motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from amhe_cli.audit import audit as module
from amhe_cli.audit import suspects
from amhe_cli.audit.audit import audit
from amhe_cli.audit.claims import claims_of, doubts_of
from amhe_cli.audit.judge import ODDS, Sheets
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.settings import AssumedSettings
from amhe_cli.engine.inverse import forces_along
from amhe_cli.estimation.core.result import Against
from amhe_cli.estimation.identification import IdentifyOptions, searched_for
from amhe_cli.estimation.offline.watch import Watch
from amhe_cli.estimation.uncertainty import misfit as misfits
from amhe_cli.init.folder import proposed, proposed_as
from amhe_cli.logs import read_log
from amhe_cli.report.audit import _against
from amhe_cli.system.system import System

ARM = """<mujoco><option timestep='0.002'/><worldbody><body name='arm'>
<joint name='elbow' axis='0 1 0' damping='0.2' armature='0.01'/>
<inertial pos='0.2 0 0' mass='0.5' diaginertia='0.001 0.004 0.004'/>
</body></worldbody>
<actuator><position name='servo' joint='elbow' kp='{}' kv='0.1' forcerange='-3 3'/></actuator></mujoco>"""
STIFF, SOFT = 400.0, 12.0


def watch(interrupted: bool = False) -> Watch:
    """The watch of a search without a limit."""
    made = Watch(lambda *_: None, None, 1)
    made.interrupted = interrupted
    return made


@pytest.mark.slow
def test_a_servo_that_is_thirty_times_too_stiff_in_its_file_is_contradicted(tmp_path: Path) -> None:
    rng, model = np.random.default_rng(0), mujoco.MjModel.from_xml_string(ARM.format(SOFT))
    data, times = mujoco.MjData(model), np.arange(0.0, 8.0, 0.01)
    targets = 0.5 * np.sin(3.0 * times) + 0.3 * np.sin(9.0 * times)
    rows = []
    for target in targets:
        rows.append((data.qpos[0] + 3e-4 * rng.standard_normal(), target))
        data.ctrl[0] = target
        mujoco.mj_step(model, data, 5)
    log, file = tmp_path / "log.csv", tmp_path / "arm.xml"
    table = np.column_stack((times, np.array(rows)))
    head = "time,position_elbow,command_position_servo"
    np.savetxt(log, table, fmt="%.6g", delimiter=",", header=head, comments="")
    file.write_text(ARM.format(STIFF), encoding="utf-8")
    proposal = proposed(file, [log], efforts=True)
    found = audit(proposal, "arm", lambda system: [read_log(log, system)], IdentifyOptions(threads=1))
    (gain,) = [line for line in found.lines if line.parameter == "servo_gain"]
    assert gain.verdict == "contradicted" and abs(gain.log - SOFT) < 4.0 * gain.sd + 0.1 * SOFT


def planar(masses: Sequence[float], armature: float) -> str:
    """Links that swing upright; their inertias are those of 2 and 1.5 kg."""
    links = "".join(
        f"""<body name='link{i}' pos='{place} 0 0'>
        <joint name='j{i}' axis='0 1 0' damping='0.3' frictionloss='0.1' armature='{armature}'/>
        <inertial pos='0.15 0 0' mass='{mass}' diaginertia='{0.00125 * own} {0.01 * own} {0.01 * own}'/>"""
        for i, (place, mass, own) in enumerate(zip((0.0, 0.3), masses, (2.0, 1.5), strict=False), 1)
    )
    return f"<mujoco><worldbody>{links}{'</body>' * len(masses)}</worldbody></mujoco>"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("truth", "masses", "contradicted"),
    [
        # the first search finds a lever of a third in place of a mass three times too large
        ((2.0, 1.5), (2.0, 4.5), {"link2_mass", "j2_armature"}),
        # of one link, both explain the torques, and the armature is known only together with the inertia
        ((2.0,), (6.0,), set()),
    ],
)
def test_what_something_else_explains_as_well_is_not_contradicted(
    tmp_path: Path, truth: Sequence[float], masses: Sequence[float], contradicted: set[str]
) -> None:
    rng, model, links = (
        np.random.default_rng(1),
        mujoco.MjModel.from_xml_string(planar(truth, 0.02)),
        len(truth),
    )
    times = np.arange(0.0, 10.0, 0.01)
    w = 2.0 * np.pi * np.geomspace(0.1, 2.0, 6)[:, None, None]
    turn = w * times[:, None] + rng.uniform(0.0, 2.0 * np.pi, (6, 1, links))
    size = 0.6 * rng.uniform(0.4, 1.0, (6, 1, links)) / (1.0 + w / 3.0)
    q, v, a = ((size * w**k * np.sin(turn + 0.5 * k * np.pi)).sum(axis=0) for k in range(3))
    torque = forces_along(model, q, v, a).needed + 0.1 * np.sign(v)
    q, torque = (x + sd * rng.standard_normal(x.shape) for x, sd in ((q, 3e-4), (torque, 0.03)))
    log, file = tmp_path / "log.csv", tmp_path / "arm.xml"
    names = [f"{what}_j{i + 1}" for what in ("position", "effort") for i in range(links)]
    table = np.column_stack((times, q, torque))
    np.savetxt(log, table, fmt="%.6g", delimiter=",", header=",".join(("time", *names)), comments="")
    file.write_text(planar(masses, 0.0), encoding="utf-8")
    proposal = proposed(file, [log], efforts=True)
    found = audit(proposal, "arm", lambda system: [read_log(log, system)], IdentifyOptions(threads=1))
    lines = {line.parameter: line for line in found.lines}
    assert {name for name, line in lines.items() if line.verdict == "contradicted"} == contradicted
    if contradicted:
        assert abs(lines["link2_mass"].log - 1.5) < 3.0 * lines["link2_mass"].sd
    else:
        assert lines["link1_mass"].verdict == "cannot tell"


@pytest.mark.parametrize("straight", [True, False])
@pytest.mark.parametrize("right", ["a", "b", "c"])
def test_where_the_evidence_falls_with_several_sheets_each_of_them_is_tried(
    monkeypatch: pytest.MonkeyPatch, right: str, straight: bool
) -> None:
    """A linearisation calls three sheets wrong, and only one of them explains the logs."""
    asked = list[frozenset[str]]()

    def searched(wrong, near) -> Any:
        asked.append(frozenset(wrong))
        return SimpleNamespace(problem=SimpleNamespace(system=None), wrong=asked[-1], watch=watch())

    def sets(evidence, sheets, wrong, right) -> dict[frozenset[str], float]:
        more = {wrong | {name}: value for name, value in (("c", 3.0), ("a", 2.0), ("b", 1.0))}
        return {frozenset("abc"): 6.0, **more, wrong: 0.0}

    @dataclass
    class Known:
        search: Any
        wrong: frozenset[str]
        claims: Any

        def against(self, first: Known) -> float:
            evidence = {frozenset(): 10.0, frozenset(right): 15.0}
            return evidence.get(self.wrong, 0.0) - evidence.get(first.wrong, 0.0)

    for name, stub in (("sketched", id), ("sheets_of", lambda *_: None), ("_far_off", lambda *_: None)):
        monkeypatch.setattr(suspects, name, stub)
    monkeypatch.setattr(suspects, "wrong_sheets", sets)
    monkeypatch.setattr(suspects, "_straight", lambda search: straight)
    monkeypatch.setattr(suspects, "Explanation", Known)
    seen: list[Any] = []
    assert suspects.without_suspects(searched, [], frozenset(), None, seen=seen)[1] == {right}
    assert {one.wrong for one in seen} == set(asked) - {frozenset(right)}  # each of them has its evidence
    assert (frozenset("abc") in asked) == straight  # slopes that bend say one sheet at a time


def test_a_search_that_is_interrupted_keeps_what_was_found_before(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[frozenset[str]]()

    def searched(wrong, near) -> Any:
        asked.append(frozenset(wrong))
        if len(asked) == 3:
            raise KeyboardInterrupt
        return SimpleNamespace(problem=SimpleNamespace(system=None), watch=watch())

    for name, stub in (("sketched", id), ("sheets_of", lambda *_: None), ("_far_off", lambda *_: None)):
        monkeypatch.setattr(suspects, name, stub)
    monkeypatch.setattr(
        suspects, "wrong_sheets", lambda _, __, wrong, right: {wrong | {str(len(wrong))}: 1.0}
    )
    monkeypatch.setattr(suspects, "_straight", lambda search: True)
    better = SimpleNamespace(against=lambda _: -1.0)
    monkeypatch.setattr(suspects, "Explanation", lambda *_: better)
    found, wrong = suspects.without_suspects(searched, [], frozenset(), None)
    assert found.watch.interrupted and wrong == {"0"} and len(asked) == 3


def test_an_interruption_before_the_second_search_begins_keeps_the_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Stopped(SimpleNamespace):
        def __init__(self, search: Any) -> None:
            super().__init__(search=search)

        def further(self) -> Any:
            raise KeyboardInterrupt

    first: Any = SimpleNamespace(problem=SimpleNamespace(system="model"), watch=watch())
    judged = SimpleNamespace(unsearched="", left=())

    def without_suspects(searched, claims, wrong, near, seen) -> Any:
        if near is not None:
            raise KeyboardInterrupt
        return first, wrong

    for name, stub in (
        ("claims_of", lambda *_: ["a claim"]), ("doubts_of", lambda _: []), ("_lines", lambda *_: []),
        ("without_suspects", without_suspects), ("concluded", lambda search, quick: search),
        ("_judgement", lambda *_: judged),
        ("replace", lambda one, **more: SimpleNamespace(**vars(one) | more)),
        ("Watch", lambda *_: first.watch), ("Explanation", lambda search, wrong, claims: Stopped(search)),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, stub)
    proposal: Any = SimpleNamespace(settings={}, match="motion")
    found = module.audit(proposal, "arm", lambda _: [], IdentifyOptions())
    assert found.found is first and first.watch.interrupted
    assert (
        found.unsearched == "the search did not end (it was interrupted), and its values are the best so far"
    )


@dataclass
class Found:
    z: FloatArray
    straight: bool = True


@dataclass
class Searching:
    finding: Found
    problem: Any
    watch: Any


def test_an_interruption_of_a_second_explanation_ends_the_audit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search ends with what it has; the audit must not go on to the next number."""
    space = SimpleNamespace(
        phi_of=np.asarray, nominal=np.zeros(1), prior_sd=np.ones(1), clip=np.asarray, names=("mass",)
    )
    problem = SimpleNamespace(system=SimpleNamespace(space=space))

    def searching(interrupted: bool) -> Any:
        return Searching(Found(np.zeros(1)), problem, watch(interrupted))

    monkeypatch.setattr(suspects, "noise_of", lambda *_: None)
    monkeypatch.setattr(Searching, "fit", None, raising=False)
    first = suspects.Explanation(searching(False), frozenset(), [])
    first.__dict__["sheets"] = SimpleNamespace(groups={("arm", "mass"): [0]}, file=np.zeros(1))
    with pytest.raises(KeyboardInterrupt):
        first.rival(lambda *_: searching(False), lambda *_: searching(True), ("arm", "mass"), 1.0)


@pytest.mark.parametrize("later", [-1.0, -50.0])
def test_a_search_that_has_not_ended_goes_on_before_it_excludes_anything(
    later: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    space = SimpleNamespace(
        phi_of=np.asarray, nominal=np.zeros(1), prior_sd=np.ones(1), clip=np.asarray, names=("mass",)
    )

    def searching(odds: float) -> Any:
        found = Searching(Found(np.full(1, odds)), SimpleNamespace(), watch())
        found.problem.system = SimpleNamespace(space=space)
        return found

    first, stopped, went_on = (
        suspects.Explanation(searching(v), frozenset(), []) for v in (0.0, -50.0, later)
    )
    sheets = SimpleNamespace(groups={("arm", "mass"): [0]}, file=np.zeros(1))
    for name, stub in (
        ("against", lambda self, *_, **__: self.search.finding.z[0]), ("to_go", (np.zeros(1), 0.0)),
        ("sheets", sheets), ("evidence", None),
    ):  # fmt: skip
        monkeypatch.setattr(suspects.Explanation, name, stub)
    monkeypatch.setattr(suspects, "wrong_sheets", lambda *_, **__: [frozenset()])
    monkeypatch.setattr(suspects, "without_suspects", lambda *given: (given[3], given[2]))
    monkeypatch.setattr(suspects, "ended", lambda search: went_on.search)
    monkeypatch.setattr(suspects, "over", lambda search: search is went_on.search)
    monkeypatch.setattr(suspects, "noise_of", lambda *_: None)
    monkeypatch.setattr(Searching, "fit", None, raising=False)
    other, over = first.rival(lambda *_: stopped.search, lambda *_: stopped.search, ("arm", "mass"), 1.0)
    assert over and (other is None or other.search is went_on.search)
    assert (other is None) == (later < suspects.HOPELESS), "only where it ended shows what it explains"


def test_each_search_for_something_else_ends_by_the_odds_of_the_sheets_that_it_leaves_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mass, gain = frozenset({("arm", "mass")}), frozenset({("arm", "gain")})
    space = SimpleNamespace(phi_of=np.asarray, nominal=np.zeros(1), prior_sd=np.ones(1), clip=np.asarray)
    search: Any = Searching(Found(np.zeros(1)), SimpleNamespace(), watch())
    search.problem.system = SimpleNamespace(space=space)
    asked = []

    def searched(wide: Any, near: Any, noise: Any, ends: Any) -> Any:
        asked.append((frozenset(wide), ends))
        return search

    def several(searched: Any, claims: Any, wrong: Any, near: Any, right: Any) -> Any:
        return [searched(sheets, near) for sheets in (wrong, [*gain], wrong)][-1], wrong

    sheets = SimpleNamespace(groups={("arm", "mass"): [0]}, file=np.zeros(1))
    for name, stub in (
        ("sheets", sheets), ("evidence", None), ("to_go", (np.zeros(1), 0.0)),
        ("against", lambda *_, **__: 0.0), ("_excludes", lambda self, *given: given),
    ):  # fmt: skip
        monkeypatch.setattr(suspects.Explanation, name, stub)
    monkeypatch.setattr(Searching, "fit", None, raising=False)
    monkeypatch.setattr(suspects, "noise_of", lambda *_: None)
    monkeypatch.setattr(suspects, "over", lambda _: True)
    monkeypatch.setattr(suspects, "wrong_sheets", lambda *_, **__: [mass])
    monkeypatch.setattr(suspects, "without_suspects", several)
    suspects.Explanation(search, frozenset(), []).rival(searched, searched, ("arm", "mass"), 4.0)
    assert [wide for wide, _ in asked[1:]] == [mass, gain, mass]
    assert [ends for _, ends in asked[1:]] == [(sheets, 4.0, False) for sheets in (mass, gain, mass)]


def test_what_few_clips_say_is_judged_under_the_noise_of_the_first_explanation() -> None:
    """And not under that for which their own search takes it, which `against` divides by once more."""
    system = System.load("pendulum", {"clips": {"count": 4}, "identify": {"iterations": 2}})
    logs = [read_log("example:pendulum", system)]
    search = searched_for(system, logs, None, IdentifyOptions(threads=1), quick=True, clips=3)
    loud = replace(search.problem, noise=suspects.noise_of(search.fit, 4.0))
    alone = suspects._misfit(search.fit, search, search.problem)
    assert suspects._misfit(search.fit, search, loud) == pytest.approx(alone, rel=0.01)


def test_what_a_search_that_stopped_may_still_gain_counts_for_its_explanation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    space = SimpleNamespace(phi_of=np.log, theta_of=np.exp)
    record = [
        SimpleNamespace(stage="polish", cost=cost, theta=(theta,))
        for cost, theta in ((8.0, 9.0), (4.0, 8.0), (3.0, 4.0), (2.0, 2.0))
    ]
    clips = SimpleNamespace(counts=np.array([30, 10]))
    fit = SimpleNamespace(
        finding=SimpleNamespace(record=record), z=np.log([2.0]), times=(1.0, 4.0),
        slopes=SimpleNamespace(cost=SimpleNamespace(clips=clips)),
    )  # fmt: skip
    search: Any = SimpleNamespace(fit=fit, problem=SimpleNamespace(system=SimpleNamespace(space=space)))
    for moving, way, fell in (("a mass", np.log(0.25), 2.0), ("", 0.0, 0.0)):
        monkeypatch.setattr(suspects, "still_moving", lambda _, moving=moving: moving)
        one = suspects.Explanation(search, frozenset(), [])
        assert one.to_go[0] == pytest.approx([way]) and one.to_go[1] == pytest.approx(fell)
        gain = 0.5 * 10.0 * fell / 2.0  # of ten independent numbers, under the noise of a cost of 2
        for now, wider in ((-20.0, 1.0), (-20.0, 2.0), (-1.0, 1.0), (3.0, 1.0)):
            monkeypatch.setattr(suspects.Explanation, "against", lambda *_, now=now: now)
            assert one.odds(one, wider) == pytest.approx(max(now, min(now + gain / wider**2, 0.0)))
    monkeypatch.undo()


@pytest.mark.parametrize(
    ("odds", "ends"),
    [([-300.0, -290.0], False), ([-300.0, -299.0], True), ([-5.0, -5.0], False), ([-300.0, -301.0], True)],
)
def test_a_search_ends_where_its_last_gain_on_every_step_left_would_change_no_verdict(
    odds: list[float], ends: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    search: Any = Searching(Found(np.zeros(1)), None, None)
    problem: Any = SimpleNamespace(settings=SimpleNamespace(identify=SimpleNamespace(iterations=16)))
    said = iter(odds)
    monkeypatch.setattr(suspects.Explanation, "against", lambda *_, **__: next(said))
    monkeypatch.setattr(suspects, "stalled", lambda *_: False)
    over = suspects.Explanation(search, frozenset(), [])._excludes(frozenset(), 1.0, True)
    assert not over(problem, SimpleNamespace(first=None)), "it has not seen all clips"
    states = [SimpleNamespace(first=np.zeros(1), record=[None] * (3 + k)) for k in range(len(odds))]
    assert [over(problem, state) for state in states] == [False, ends]


@pytest.mark.parametrize(
    ("costs", "enough", "ends"),
    [
        ([9.0, 2.0, 2.0, 1.99], None, True), ([9.0, 2.0, 1.5, 1.0], None, False),
        ([9.0, 2.0, 1.9, 1.8], None, False), ([9.0, 2.0, 1.9, 1.8], 3.0, True), ([1.99], None, False),
    ],
)  # fmt: skip
def test_a_search_stalls_where_its_steps_gain_less_than_noise_or_than_it_may_leave(
    costs: list[float], enough: float | None, ends: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twenty independent residuals: a cost that falls by a twentieth has gained one squared noise sd."""
    residuals = SimpleNamespace(flat=np.zeros((1, 1, 1)), completed=np.ones((1, 1), dtype=bool))
    cost = SimpleNamespace(
        nx=0, times=None, clips=SimpleNamespace(counts=np.array([100])), residuals=lambda *_: residuals
    )
    monkeypatch.setattr(misfits, "channel_times", lambda *_: (5.0,))
    system = SimpleNamespace(match="motion")
    problem: Any = SimpleNamespace(clips=(), cost=lambda *_: cost, enough=enough, system=system)
    record = [SimpleNamespace(cost=one, stage="polish") for one in costs]
    state: Any = SimpleNamespace(
        first=np.zeros(1), number=len(costs) + 2, scale={}, z=np.zeros(1), record=record
    )
    assert misfits.stalled(problem, state) == ends
    system.match = "effort"
    assert not misfits.stalled(problem, state)


@pytest.mark.parametrize("wider", [1.0, 2.0])
def test_wider_noise_makes_less_of_a_misfit_and_leaves_the_odds_of_sheets(
    monkeypatch: pytest.MonkeyPatch, wider: float
) -> None:
    space = SimpleNamespace(phi_of=np.asarray, theta_of=np.asarray)
    problem = SimpleNamespace(system=SimpleNamespace(space=space))

    def explained(wrong: frozenset[Any], misfit: float) -> suspects.Explanation:
        search: Any = SimpleNamespace(problem=problem, finding=Found(np.zeros(1)), fit=None, misfit=misfit)
        found = suspects.Explanation(search, wrong, [])
        found.__dict__["sheets"] = Sheets({"mass": [0]}, np.zeros(1), np.ones(1), np.full(1, 10.0))
        found.__dict__["evidence"] = SimpleNamespace(information=4.0 * np.eye(1))
        return found

    monkeypatch.setattr(suspects, "_misfit", lambda fit, of, few: of.misfit)
    right, wrong = explained(frozenset(), 50.0), explained(frozenset({"mass"}), 20.0)
    spread = np.log1p(400.0 / wider**2) - np.log1p(4.0 / wider**2)
    odds = 15.0 / wider**2 - ODDS - 0.5 * spread
    assert wrong.against(right, wider) == pytest.approx(odds)


def test_what_was_seen_is_cut_only_where_the_noise_is_that_of_held_out_clips(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen, judged = [SimpleNamespace(wrong=frozenset("a"), against=lambda *_: -15.0)], []
    monkeypatch.setattr(module, "concluded", lambda search, quick: SimpleNamespace(unexplained=()))
    monkeypatch.setattr(module, "_unjudged", lambda found: "not judged")
    monkeypatch.setattr(module, "_judgement", lambda found, first, others, _: judged.extend(others))
    first: Any = SimpleNamespace(search=SimpleNamespace(watch=watch()))
    module._concluded(lambda *_: 0, lambda *_: 0, first, seen)  # type: ignore[arg-type]
    assert judged == seen


def test_a_set_of_sheets_counts_once() -> None:
    def explained(wrong: str) -> Any:
        return suspects.Explanation(SimpleNamespace(), frozenset(wrong), [])  # type: ignore[arg-type]

    first, again, one, better, hopeless = (explained(wrong) for wrong in ("a", "a", "b", "b", "c"))
    kept = module._once({first: 0.0, again: 1.0, one: -1.0, better: -0.5, hopeless: -11.0})
    assert kept == {first: 0.0, better: -0.5}


def test_only_held_out_clips_that_are_missed_more_leave_numbers_judged() -> None:
    """A search that was cut short says so in one sentence, whatever held-out clips say."""
    missed = Against("held out", "the model misses joints.position of held-out clips twice as much")

    def found(*texts: Against) -> Any:
        held_out = SimpleNamespace(misses={"joints.position": 2.0})
        return SimpleNamespace(unexplained=texts, held_out=held_out, interrupted=False, settled=True)

    def against(*texts: Against, unsearched: str = "") -> list[str]:
        audit: Any = SimpleNamespace(found=found(*texts), unsearched=unsearched)
        return list(_against(audit))

    assert module.unexplained(found(missed)) == () and not module._unjudged(found(missed))
    assert module._wider(found(missed)) == 2.0
    assert against(missed) == [f"{missed.text}: every sd is wider by that factor"]
    assert against(Against("short", "it did not end"), unsearched="it had 3 s") == ["it had 3 s"]
    for kind in ("misfit", "left out", "worse", "short"):
        other = Against(kind, "it misses")
        assert module.unexplained(found(missed, other)) == (other,)
        assert module._unjudged(found(other)).startswith("no value explains these logs")
        assert all("not explained" in text for text in against(missed, other))


def test_first_states_are_those_of_a_search_that_cut_the_same_clips_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cost = SimpleNamespace(residuals=lambda *_: None)
    space = SimpleNamespace(z_of=np.asarray, theta_of=np.asarray, prior_sd=np.ones(1))

    def fit(start: int) -> Any:
        clip = SimpleNamespace(log=SimpleNamespace(source="log"), start=start, length=5)
        problem = SimpleNamespace(
            clips=(clip,), system=SimpleNamespace(space=space), cost=lambda clips, scale: cost
        )
        return SimpleNamespace(
            problem=problem, space=space, weight=np.ones(1), shape=np.eye(1), times=(1.0,),
            finding=SimpleNamespace(scale={}),
        )  # fmt: skip

    anew = SimpleNamespace(misfit=lambda times: np.array([7.0]))
    monkeypatch.setattr(suspects, "scored", lambda *_: anew)
    monkeypatch.setattr(suspects, "clip_objectives", lambda *_: np.array([[3.0]]))
    for start, misfit in ((0, 3.0), (5, 7.0)):
        finding = SimpleNamespace(z=np.zeros(1), first=SimpleNamespace(mean=np.zeros((1, 2))))
        of: Any = SimpleNamespace(problem=fit(start).problem, finding=finding)
        assert suspects._misfit(fit(0), of, None) == misfit


def test_what_a_system_folder_adds_to_a_file_is_unknown_too() -> None:
    """A zero, a servo's supply and friction that grows with the load stand in no file; its gain does."""
    folder = Path(__file__).parents[2] / "examples" / "systems" / "xl330"
    proposal = proposed_as(folder / "model.xml", System.load(folder))
    names = [one.name for one in doubts_of(proposal)]
    assert names == ["back_emf", "supply_sag", "load_friction", "zero", "delay"]
    alone = replace(proposal, parameters=[])
    assert [one.name for one in doubts_of(alone)] == [
        "pendulum_offset",
        "command_delay",
        "servo_command_offset",
    ]
    claimed = [claim.parameter for claim in claims_of(proposal, AssumedSettings())]
    assert {"servo_gain", "load_mass"} < set(claimed) and not set(names) & set(claimed)
    assert set(proposal.system("xl330").space.names) == set(names)


@pytest.mark.parametrize("given", [0, {"gain": 0.0}])
def test_what_is_said_to_be_exact_is_no_doubt(given: Any) -> None:
    """`assumed: 0` says so of all."""
    found = module._assumed({"identify": {"assumed": given}})
    assert found.gain == 0.0 and (found.mass == 0.0) == (given == 0)


@pytest.mark.parametrize("wrong", [{"identify": 3}, {"identify": {"assumed": "much"}}])
def test_settings_that_are_none_are_left_to_the_system(wrong: Any) -> None:
    assert module._assumed(wrong) == AssumedSettings()
