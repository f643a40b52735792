"""Look up the locked packages in the database of known vulnerabilities, by pip-audit.

`make audit` gives it what `uv export` makes of uv.lock; it ends with 1 where one is known.

Without network, or where no data on the packages can be had, it says so and does not fail.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

PIP_AUDIT = "pip-audit==2.10.1"


def main() -> None:
    """Run pip-audit and report."""
    uvx = Path(sys.executable).with_name("uvx")
    options = ("--disable-pip", "--require-hashes", "--format", "json", "--progress-spinner", "off")
    run = subprocess.run(
        [str(uvx), PIP_AUDIT, "--requirement", "/dev/stdin", *options],
        capture_output=True,
        text=True,
    )
    lines, known = report(run.stdout)
    print("\n".join(lines))
    sys.exit(1 if known else 0)


def report(text: str) -> tuple[list[str], bool]:
    """Return what pip-audit's JSON says in lines, and whether a vulnerability is known."""
    try:
        packages = json.loads(text)["dependencies"]
    except (ValueError, KeyError, TypeError):
        return ["audit: pip-audit or its data cannot be reached, so nothing is known"], False
    found = [
        f"{package['name']} {package['version']}: {each['id']}, fixed in "
        f"{', '.join(each['fix_versions']) or 'no version yet'}"
        for package in packages
        for each in package.get("vulns", ())
    ]
    skipped = sum("skip_reason" in package for package in packages)
    if skipped == len(packages):
        return ["audit: there is no data on any of the packages here, so nothing is known"], False
    audited = f"audit: {len(packages) - skipped} of {len(packages)} packages looked up"
    return [f"{audited}, {len(found)} known vulnerabilities", *found], bool(found)


if __name__ == "__main__":
    main()
