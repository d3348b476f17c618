"""The rig of an explanation, and a rig as the text of a rig file."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.rig.schema import Parameter, Rig


def explained(fitted: Fitted) -> Rig:
    """The rig with the effects of a fit in it and the uncertain parameters refitted.

    What was identified says so and has the standard deviation found as its tolerance. A rig file
    has no nonlinear force: the rig is that without it, and its description says which it was.
    """
    model, x = fitted.model, fitted.x
    sd = np.sqrt(np.diag(fitted.covariance()))
    values = model.values(x)
    spread = dict(zip(model.keys, sd[: model.n_nominal].tolist(), strict=True))
    at = model.n_nominal
    for effect, theta in zip(model.effects, model.parts(x), strict=True):
        width = float(np.max(sd[at : at + len(theta)], initial=0.0))
        at += len(theta)
        for key in effect.parameters(theta, {**model.nominal, **values}):
            spread[key] = min(width, 10.0)
    rig = model.built.model_copy(
        update={"element": tuple(valued(e, values, spread) for e in model.built.element)}
    )
    for effect, theta in zip(model.effects, model.parts(x), strict=True):
        rig = effect.write(rig, theta)
        if effect.force is not None:
            symbol, unit = effect.unknowns[0].symbol, effect.unknowns[0].unit
            found = f"{effect.physics.replace('_', ' ')} at {effect.site}"
            value = f"{symbol} = {effect.report(theta)[0]:.4g} {unit}"
            remark = f"Found beside this linear rig: {found}, {value}."
            rig = rig.model_copy(update={"description": f"{rig.description} {remark}".strip()})
    return rig


def valued(
    element: Any, values: dict[tuple[str, str], float], spread: dict[tuple[str, str], float]
) -> Any:
    """An element with other values of its parameters, and their tolerances."""
    update: dict[str, Any] = {}
    for symbol, p in iter(element):
        key = (element.name, symbol)
        if isinstance(p, Parameter) and key in values:
            change = {
                "value": values[key],
                "tolerance": round(spread.get(key, p.tolerance), 6),
                "source": f"identified from recordings; before: {p.value:g}, {p.source}",
            }
            if p.source.startswith("not in the nominal"):
                change["source"] = "identified from recordings; not in the nominal rig file"
            update[symbol] = p.model_copy(update=change)
    if getattr(element, "kind", "") == "branch":
        update["element"] = tuple(valued(e, values, spread) for e in element.element)
    return element.model_copy(update=update)


def toml(rig: Rig) -> str:
    """The rig as a rig file: parameters as inline tables, lists of elements and channels."""
    data = rig.model_dump(exclude_defaults=True, exclude_none=True)
    top = [f"{k} = {_value(v)}" for k, v in data.items() if not isinstance(v, dict | tuple | list)]
    out = ["\n".join(top)]
    for key, value in data.items():
        if isinstance(value, tuple | list):
            out += [f"[[{key}]]\n{_table(item)}" for item in value]
        elif isinstance(value, dict):
            out.append(f"[{key}]\n{_table(value)}")
    return "\n\n".join(out) + "\n"


def _table(data: dict[str, Any]) -> str:
    return "\n".join(f"{k} = {_value(v)}" for k, v in data.items())


def _value(value: Any) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return json.dumps(value, ensure_ascii=False)
        case int():
            return str(value)
        case float():
            return repr(float(value)) if np.isfinite(value) else str(value)
        case dict():
            inner = ", ".join(f"{k} = {_value(v)}" for k, v in value.items())
            return "{ " + inner + " }"
        case list() | tuple():
            return "[" + ", ".join(_value(v) for v in value) + "]"
    raise TypeError(type(value))
