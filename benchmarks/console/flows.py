"""Rows of the flows: results of the browser tests."""

import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from benchmarks.report import ROOT, Report

FLOWS = ROOT / "tests" / "console" / "test_flows.py"


def flow_rows(report: Report) -> None:
    """Run the flows; a skipped flow counts as not passed.

    Args:
        report: collects the rows.
    """
    with tempfile.TemporaryDirectory() as folder:
        results = Path(folder) / "results.xml"
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junitxml={results}", str(FLOWS)]
        subprocess.run(command, cwd=ROOT, check=False)
        cases = list(ElementTree.parse(results).getroot().iter("testcase"))  # noqa: S314  # pytest wrote it
    passed = np.array([len([each for each in case if each.tag != "properties"]) == 0 for case in cases])
    report.share("console.flows_passed", passed, bar=1.0)
