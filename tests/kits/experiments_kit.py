"""What tests of the experiments share."""

from __future__ import annotations


def toml(table):
    def shown(x):
        if isinstance(x, str):
            return '"' + x + '"'
        if isinstance(x, list | tuple):
            return "[" + ", ".join(map(shown, x)) + "]"
        return {True: "true", False: "false"}.get(x, repr(x)) if isinstance(x, bool) else repr(x)

    return "\n".join(f"{k} = {shown(v)}" for k, v in table.items())
