"""The papers' own story, concealed: what is said when the other model is the truth.

python benchmarks/papers_story.py [CASE ...]      (the names are those of `STORY`)

The concealed plant (`sim.concealed`: finite elements in time, no code of the model that reads its
recordings) makes trials from stated effects: nine runs, three levels, errors and converters of the
rig file, parameters drawn within their tolerances. Each is diagnosed with a rig file that has
perfect joints, a perfect source, or the encoder on the other side of the spring. Trials that are
whole are not made again (`--out`, else a temporary folder); `--seed` draws others.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.result import Cause, Diagnosis
from samii_rig.papers.measure import continuous
from samii_rig.papers.spring_damper import first_order, laplace
from samii_rig.papers.velocity_feedback import AROUND, dip_and_rise
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import AngularVelocitySource, Rig, TorsionalSpring
from samii_rig.signal.estimate import estimate
from samii_rig.types import FrequencyResponse, Recording
from sim.concealed.draw import edited
from sim.concealed.runs import Design
from sim.concealed.scales import RIGID
from sim.concealed.stated import Stated
from sim.concealed.trial import make

SOURCE, JOINT, ENCODER = "joint_2_source", "joint_2", "theta_2"
GIVES = 700.0  # N m s/rad, the velocity feedback of an actuator that gives
ALTERNATIVES = 3  # that are told


def perfect(rig: Rig, *names: str) -> Rig:
    """The rig without the joints named, or without all: they do not give."""
    gone = {
        e.name
        for e in rig.element
        if isinstance(e, TorsionalSpring) and (not names or e.name in names)
    }
    data = rig.model_dump()
    data["element"] = [e for e in data["element"] if e["name"] not in gone]
    for sensor in data["sensor"]:
        if "across" in sensor:
            sensor["across"] = tuple(n for n in sensor["across"] if n not in gone)
    return Rig.model_validate(data)


@dataclass(frozen=True, slots=True)
class Case:
    """hidden : what the plant has; rigid : joints that do not give in it. missing : joints that
    the rig file of the diagnosis leaves out, all if empty, none if None. outputs : looked at."""

    says: str
    hidden: tuple[Stated, ...]
    rigid: tuple[str, ...] = ()
    missing: tuple[str, ...] | None = (JOINT,)
    outputs: tuple[str, ...] | None = None


def spring_of(name: str) -> Stated:
    """A joint that gives as the rig file says: the stiffness of the papers."""
    e = next(e for e in load_rig("samii")[0].element if e.name == name)
    assert isinstance(e, TorsionalSpring)
    return Stated("torsional_compliance", name, {"k": e.k.value, "c": e.c.value})


FOUR = tuple(map(spring_of, ("clamp", "joint_1", "joint_2", "joint_3")))
SPRING = (spring_of(JOINT),)
FEEDBACK = (Stated("velocity_feedback", SOURCE, {"g_v": GIVES}),)
STORY = {
    "joints": Case("all joints give; perfect joints, perfect source", FOUR, missing=()),
    "spring": Case("spring-damper, the encoder across it; perfect source", SPRING),
    "feedback": Case("velocity feedback, no spring; perfect source", FEEDBACK, rigid=(JOINT,)),
    "encoder": Case(
        "encoder at the source; across source and spring",
        (Stated("noncollocated_encoder", ENCODER),),
        missing=None,
    ),
    "theta_spring": Case("as spring, theta_2 alone", SPRING, outputs=(ENCODER,)),
    "theta_feedback": Case(
        "as feedback, theta_2 alone", FEEDBACK, rigid=(JOINT,), outputs=(ENCODER,)
    ),
    "theta_joints": Case("as joints, theta_2 alone", FOUR, missing=(), outputs=(ENCODER,)),
}


def recorded(case: Case, out: Path, seed: int = 0, design: Design | None = None) -> list[Recording]:
    """The runs of a case, made by the concealed plant or found made."""
    text = load_rig("samii")[1]
    for name in case.rigid:
        text = edited(text, {(name, "k"): (RIGID, "rigid"), (name, "c"): (0.0, "rigid")})
    folder = make("stated", seed, out, text, design, case.hidden)
    return [read_recording(path) for path in sorted(folder.glob("*.mcap"))]


def nominal(case: Case) -> Rig:
    """The rig file that the diagnosis is given."""
    rig = load_rig("samii")[0]
    return rig if case.missing is None else perfect(rig, *case.missing)


def phase(response: FrequencyResponse, rig: Rig) -> str:
    """How theta_2/v_2 turns against the perfect source, near mode 2."""
    source = next(e for e in rig.element if isinstance(e, AngularVelocitySource))
    at = [y.name for y in response.outputs].index(ENCODER)
    f = response.frequency
    near = (f > AROUND[0]) & (f < AROUND[1])
    H = continuous(response, rig)[near, at, 0]
    own = first_order(laplace(f[near]), source.K.value, source.p.value)
    dip, dip_hz, rise, rise_hz = dip_and_rise(f[near], H, own)
    return f"{dip:.0f} deg at {dip_hz:.1f} Hz, then {rise:+.0f} deg at {rise_hz:.1f} Hz"


def said(causes: Sequence[Cause]) -> str:
    """An explanation in one line."""
    words = []
    for c in causes:
        numbers = ", ".join(f"{s} {v.value:.4g} ({v.low:.4g} to {v.high:.4g})"
                            for s, v in c.parameters.items())  # fmt: skip
        same = ", ".join(f"{p} at {s}" for p, s in c.equivalents)
        words.append(f"{c.physics} at {c.site} {numbers}" + (f" [= {same}]" if same else ""))
    return "; ".join(words) or "nothing"


def show(name: str, found: Diagnosis, turned: str, seconds: float) -> None:
    """What was said of one case."""
    print(f"{name}: {STORY[name].says}")
    print(f"    theta_2/v_2 against the perfect source: {turned}")
    sure = min((c.probability for c in found.causes), default=0.0)
    print(f"    {found.verdict}, {sure:.2f}: {said(found.causes)}")
    for causes, p in found.alternatives[:ALTERNATIVES]:
        print(f"    or {p:.3f}: {said(causes)}")
    for text in found.not_physics:
        print(f"    told: {text}")
    print(f"    next: {found.experiment or '-'}; why: {found.why or '-'}")
    before, after = found.nominal[0], found.with_causes[0]
    print(f"    chi-square per dof {before:.3g} to {after:.3g}; {seconds:.0f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("which", nargs="*", default=[])
    parser.add_argument("--out", type=Path, help="folder for the trials and the answers")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    with TemporaryDirectory() as temporary:
        out = given.out or Path(temporary)
        for name in given.which or STORY:
            case, rig = STORY[name], nominal(STORY[name])
            runs = recorded(case, out, given.seed)
            start = time.process_time()
            responses = estimate(runs, outputs=case.outputs)
            found = diagnose(responses, rig, runs=runs)
            loudest = max(responses, key=lambda r: (r.estimator == "settled", r.level))
            show(name, found, phase(loudest, rig), time.process_time() - start)
            answer = out / f"{name}-{given.seed}.json"
            answer.write_text(json.dumps(found.plain(), indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
