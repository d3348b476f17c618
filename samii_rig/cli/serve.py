"""`samii-rig serve`: the service."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from samii_rig.cli.common import RigOption
from samii_rig.cli.options import takes

if TYPE_CHECKING:
    from samii_rig.errors import InputError
    from samii_rig.rig.schema import Rig
    from samii_rig.serve.access import Role, Tokens
    from samii_rig.serve.settings import Settings


@dataclass(frozen=True, kw_only=True)
class ServeOptions:
    """Words of `samii-rig serve`."""

    rig: RigOption = "samii"
    folder: Annotated[Path, typer.Option(help="Folder of the recordings.")] = Path("runs")
    host: Annotated[
        str, typer.Option(help="Address to listen at; beyond this machine it wants TLS and tokens.")
    ] = "127.0.0.1"
    port: Annotated[int, typer.Option(help="Port to listen at; 0 for any that is free.")] = 8340
    stop_port: Annotated[
        int | None,
        typer.Option(
            help="Port of the stop's own listener; 0 for any [default: the one after --port]"
        ),
    ] = None
    tls_cert: Annotated[
        Path | None, typer.Option("--tls-cert", help="Certificate chain (PEM).")
    ] = None
    tls_key: Annotated[Path | None, typer.Option("--tls-key", help="Its private key (PEM).")] = None
    tokens: Annotated[
        Path | None, typer.Option(help="File of hashed tokens; with it everybody needs one.")
    ] = None
    name: Annotated[
        list[str] | None,
        typer.Option(help="Name by which browsers call it, as through a proxy. May be repeated."),
    ] = None
    proxy: Annotated[
        list[str] | None,
        typer.Option(
            help="Address of a proxy whose X-Forwarded-For says who asks. May be repeated."
        ),
    ] = None
    pace: Annotated[
        float,
        typer.Option(help="Of a simulated rig: times real time; 0 for as fast as it can.", min=0.0),
    ] = 1.0
    foxglove: Annotated[
        int | None,
        typer.Option(
            help="Port of this machine at which Foxglove sees runs live, without a token; 0 for "
            "any [default: none]",
            min=0,
            max=65535,
        ),
    ] = None
    foxglove_open: Annotated[
        bool,
        typer.Option(
            "--foxglove-open",
            help="With --tokens: who reaches the port of --foxglove may look without one.",
        ),
    ] = False
    new_token: Annotated[
        str | None,
        typer.Option("--new-token", help="Add a token for this person to --tokens, show it, end."),
    ] = None
    role: Annotated[str, typer.Option(help="Of the new token: viewer or operator.")] = "viewer"

    def settings(self, rig: Rig, text: str, tokens: Tokens | None) -> Settings:
        """What the service goes by."""
        from samii_rig.serve.settings import Settings

        return Settings(
            rig=rig,
            rig_toml=text,
            folder=self.folder,
            host=self.host,
            port=self.port,
            tls=(self.tls_cert, self.tls_key) if self.tls_cert and self.tls_key else None,
            tokens=tokens,
            names=tuple(self.name or ()),
            pace=self.pace,
            foxglove=self.foxglove,
            foxglove_open=self.foxglove_open,
            stop_port=self.stop_port,
            proxies=frozenset(self.proxy or ()),
        )


@takes(ServeOptions)
def serve(o: ServeOptions) -> None:
    """Serve the rig to a lab: API, live data, recordings, a page.

    One person drives, the others watch; everybody can stop. A run goes on when the service is
    killed (or stops, as the rig file says), and is found again when it is started anew.

    Example: samii-rig serve --rig samii --folder runs --port 8340
    """
    from samii_rig.cli.arguments import check_rig

    check_rig(o.rig)
    _check(o)

    from samii_rig.rig.load import load_rig

    rig, text = load_rig(o.rig)
    try:
        from samii_rig.serve.access import Tokens

        known = Tokens(o.tokens) if o.tokens else None
        if o.new_token is not None and known is not None:
            typer.echo(known.add(o.new_token, cast("Role", o.role)))
            return
        settings = o.settings(rig, text, known)
        settings.check()

        from samii_rig.serve.app import serve as run
    except ModuleNotFoundError as error:
        raise _without(error) from error
    run(settings)


def _check(o: ServeOptions) -> None:
    """InputError for what does not go together."""
    from samii_rig.errors import InputError

    if os.name != "posix":
        expected = "Linux or macOS, whose signals and locks it uses"
        raise InputError("samii-rig serve", "", os.name, expected)
    if o.new_token is not None and o.tokens is None:
        raise InputError("--new-token", "--tokens", None, "the file that keeps its hash")
    if o.new_token is not None and o.role not in ("viewer", "operator"):
        raise InputError("--new-token", "--role", o.role, "viewer or operator")
    if (o.tls_cert is None) != (o.tls_key is None):
        raise InputError("samii-rig serve", "--tls-cert", str(o.tls_cert), "--tls-key beside it")


def _without(error: ModuleNotFoundError) -> InputError:
    """What is said where the service's own packages are not installed."""
    from samii_rig.errors import InputError

    said = f"needs {error.name}, which is not installed; pip install 'samii-rig[serve]'"
    return InputError.saying("samii-rig serve", "", said)
