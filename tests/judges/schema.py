#!/usr/bin/env python3
"""Another validator judges the JSON schema of the machine file (`ecaxis schema`).

Every example must be valid. Examples with an unknown key or a value of a wrong type must not be, where `ecaxis check`
rejects them. Run in an environment with `requirements.txt` installed: `python tests/judges/schema.py`.
"""

import copy
import json
import pathlib
import subprocess
import sys
import tempfile
import tomllib

import jsonschema
import rig

VALUES = [True, 7, 1.5, "word", [], {}]
# Of each example; the Rust tests replace all.
SAMPLE = 17


def places(value, place=()):
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else []
    for key, inner in items:
        yield (*place, key)
        yield from places(inner, (*place, key))


def with_value(document, place, value):
    changed = copy.deepcopy(document)
    inner = changed
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    return changed


def toml(value):
    """Formats a value as inline TOML."""
    match value:
        case dict():
            return "{ " + ", ".join(f"{json.dumps(key)} = {toml(inner)}" for key, inner in value.items()) + " }"
        case list():
            return "[" + ", ".join(map(toml, value)) + "]"
        case _:
            return json.dumps(value, ensure_ascii=False)


def check_rejects(program, path, document):
    """Returns whether `ecaxis check` rejects a key or a type."""
    with tempfile.NamedTemporaryFile("w", dir=path.parent, prefix=".judge-", suffix=".toml") as file:
        file.write("".join(f"{json.dumps(key)} = {toml(value)}\n" for key, value in document.items()))
        file.flush()
        ran = subprocess.run([program, "check", file.name, "--json"], capture_output=True, text=True)
    problems = json.loads(ran.stdout)["problems"]
    return any(p["message"].startswith(("unknown key", "expected ")) for p in problems)


def main():
    program = rig.binary()
    schema = json.loads(subprocess.run([program, "schema"], check=True, capture_output=True).stdout)
    jsonschema.Draft7Validator.check_schema(schema)
    validator = jsonschema.Draft7Validator(schema)
    files = sorted((rig.ROOT / "configs").rglob("*.toml"))
    # Files of `ecaxis-fleet` are no machine files.
    files = [path for path in files if path.parent.name != "fleet"]
    changes, rejected, wrong = 0, 0, []
    for path in files:
        document = tomllib.loads(path.read_text())
        wrong += [f"{path.name}: {error.json_path}: {error.message}" for error in validator.iter_errors(document)]
        for number, place in enumerate(list(places(document))):
            # In the steps of a subprogram, a parameter may stand for any value.
            if number % SAMPLE or (place[0] == "sub" and "step" in place):
                continue
            for value in [*VALUES, {"unknown_key": 1}]:
                changed = with_value(document, place, value)
                changes += 1
                if validator.is_valid(changed) and check_rejects(program, path, changed):
                    wrong.append(f"{path.name}: {place} = {value}: only `check` rejects it")
                else:
                    rejected += not validator.is_valid(changed)
    print(f"{len(files)} examples, {changes} changes, {rejected} rejected by the schema, {len(wrong)} wrong")
    print("\n".join(wrong))
    return 1 if wrong or not rejected else 0


if __name__ == "__main__":
    sys.exit(main())
