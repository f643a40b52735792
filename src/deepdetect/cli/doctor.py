"""`deepdetect doctor`: what is installed, what works, what is missing for what."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import click

from ._options import json_option, print_json, print_table

if TYPE_CHECKING:
    from ._findings import Finding

MARKS = {"ok": "", "warning": "WARNING: ", "problem": "PROBLEM: "}


@click.command(short_help="Check the installation, and say what to do about it.")
@click.option(
    "--self-test/--no-self-test",
    default=True,
    show_default=True,
    help="Detect and match two small pictures with a known answer.",
)
@json_option
@click.pass_context
def doctor(context: click.Context, self_test: bool, as_json: bool) -> None:
    """Check the installation: versions, OpenCV, back ends, threads, folders, extras, a self-test.

    Ends with exit code 0 where all that is installed works, and with 1 where something does not.
    Extras that are not installed are listed with what they are for; they are no problem. Nothing
    is sent anywhere; please add what --json prints to a report of a problem.

    \b
    deepdetect doctor
    deepdetect doctor --json > doctor.json
    """
    from .._shared.progress import stage_progress
    from ._findings import findings_of
    from ._installation_checks import CHECKS
    from ._self_test import run_self_test

    checks = [*CHECKS, *([run_self_test] if self_test else [])]
    names = [check.__name__.removeprefix("check_").replace("_", " ") for check in checks]
    findings: list[Finding] = []
    with stage_progress("looking", names) as done:
        for check, name in zip(checks, names, strict=True):
            findings += findings_of(check)
            done(name)
    healthy = not any(finding.status == "problem" for finding in findings)
    if as_json:
        print_json(
            {
                "ok": healthy,
                "findings": [asdict(finding) for finding in findings],
            }
        )
    else:
        _print(findings)
    if not healthy:
        context.exit(1)


def _print(findings: list[Finding]) -> None:
    there = [finding for finding in findings if finding.status != "missing"]
    absent = [finding for finding in findings if finding.status == "missing"]
    print_table([(each.name, MARKS[each.status] + each.value) for each in there])
    if absent:
        rows = [(each.name, f"{each.value}: {each.details['install']}") for each in absent]
        click.echo()
        print_table(rows, "not installed, and needed only for what is named")
    remedies = [(each.name, each.remedy) for each in findings if each.remedy]
    click.echo()
    if remedies:
        print_table(remedies, "what to do")
    else:
        click.echo("all that is installed works")
