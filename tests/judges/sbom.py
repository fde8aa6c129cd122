#!/usr/bin/env python3
"""CycloneDX' own library judges the bill of materials, and the program itself: a crate that is in it must be listed.

The compiler leaves the paths of the sources in the program: NAME-VERSION below the folder of the registry. Run in an
environment with `requirements.txt` installed: `python tests/judges/sbom.py`.
"""

import json
import re
import subprocess
import sys

import rig
from cyclonedx.model.bom import Bom
from cyclonedx.schema import SchemaVersion
from cyclonedx.spdx import is_expression
from cyclonedx.validation.json import JsonStrictValidator
from report import Report

CRATE = re.compile(rb"registry/src/[^/\0]+/([A-Za-z0-9_-]+?)-(\d+\.\d+\.\d+[A-Za-z0-9.+-]*)/")


def main():
    report = Report()
    report.section("the bill of materials")
    made = lambda *words: subprocess.run([rig.ROOT / "packaging/sbom", *words], check=True, capture_output=True, text=True).stdout  # noqa: E731
    text = made()
    document = json.loads(text)
    report.equal("the schema has no complaint", JsonStrictValidator(SchemaVersion.V1_6).validate_str(text), None)
    bom = Bom.from_json(document)
    report.check("each dependency is a component", bom.validate())
    components = document["components"]
    wrong = [(part["name"], e) for part in components for e in part["licenses"] if not is_expression(e["expression"])]
    report.equal("each licence is an expression of SPDX", wrong, [])
    fetched = [part for part in components if "purl" in part]
    unchecked = [part["name"] for part in fetched if not part.get("hashes")]
    report.equal("each crate of the registry has its hash", unchecked, [])

    required = {(part["name"], part["version"]) for part in fetched if part["scope"] == "required"}
    program = {tuple(word.decode() for word in found) for found in CRATE.findall(rig.binary().read_bytes())}
    report.check("the program names its crates", len(program) > 50, len(program))
    report.equal("each crate in the program is listed as required", sorted(program - required), [])
    notices = made("--notices")
    unnamed = [f"{name} {version}" for name, version in sorted(required) if f"\n{name} {version}: " not in notices]
    report.equal("each required crate has its licence in the notices", unnamed, [])
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
