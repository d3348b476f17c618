"""What a plain installation is made of, as CycloneDX 1.6: versions, hashes, licences, needs.

Written from `requirements.txt` and what the installed packages state, so the same pins give the
same bytes. The document is held against the schema of CycloneDX before it is written.
"""

from __future__ import annotations

import json
import re
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

from cyclonedx.model import ExternalReference, ExternalReferenceType, HashAlgorithm, HashType, XsUri
from cyclonedx.model.bom import Bom
from cyclonedx.model.component import Component, ComponentType
from cyclonedx.model.license import DisjunctiveLicense
from cyclonedx.output.json import JsonV1Dot6
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
from packageurl import PackageURL
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name as plain_name

from tools.licences import ELSEWHERE, packages

ROOT = Path(__file__).resolve().parent.parent


def hashes() -> dict[str, list[str]]:
    """SHA-256 of each file that an installation may take, by package."""
    text = (ROOT / "requirements.txt").read_text("utf-8")
    blocks = re.findall(r"^([\w.-]+)==.*((?:\n    --hash=.*)+)", text, re.M)
    return {name: re.findall(r"sha256:(\w+)", block) for name, block in blocks}


def component(name: str, version: str, licence: str, sums: list[str]) -> Component:
    """One package, by the address that package managers share."""
    address = PackageURL("pypi", None, name, version)
    files = ExternalReference(
        type=ExternalReferenceType.DISTRIBUTION,
        url=XsUri(str(address)),
        comment="any of its files",
        hashes=[HashType(alg=HashAlgorithm.SHA_256, content=s) for s in sums],
    )
    return Component(
        name=name,
        version=version,
        purl=address,
        bom_ref=str(address),
        external_references=[files] if sums else [],
        licenses=[] if licence == ELSEWHERE else [DisjunctiveLicense(name=licence)],
    )


def needs(wanted: list[str]) -> set[str]:
    """Names in a list of requirements, as they hold on this system without extras."""
    found = map(Requirement, wanted)
    return {plain_name(r.name) for r in found if not r.marker or r.marker.evaluate({"extra": ""})}


def bill() -> Bom:
    """The program, its packages, and which of them needs which."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    sums = hashes()
    parts = {
        p.name: component(p.name, p.version, p.licence, sums[p.name]) for p in packages() if p.plain
    }
    root = component(project["name"], project["version"], project["license"], [])
    root.type = ComponentType.APPLICATION
    made = Bom(components=parts.values())
    made.metadata.component = root
    made.register_dependency(root, [parts[n] for n in needs(project["dependencies"])])
    for name, part in parts.items():
        try:
            wanted = needs(requires(name) or [])
        except PackageNotFoundError:  # of another system; its licence says so too
            wanted = set()
        made.register_dependency(part, [parts[n] for n in wanted if n in parts])
    return made


def main(arguments: list[str]) -> int:
    """Write the bill beside what is built, or where it is asked for."""
    made = json.loads(JsonV1Dot6(bill()).output_as_string())
    # Number and time of writing would make two bills of the same things differ.
    del made["serialNumber"], made["metadata"]["timestamp"]
    text = json.dumps(made, indent=2)
    if error := JsonStrictValidator(SchemaVersion.V1_6).validate_str(text):
        print(f"sbom: not CycloneDX 1.6: {error}", file=sys.stderr)
        return 1
    out = Path(arguments[0]) if arguments else ROOT / "dist" / "samii-rig.cdx.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text + "\n", encoding="utf-8")
    print(f"{out}: {len(made['components'])} packages")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
