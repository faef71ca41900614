"""The console checks the focal length by the same rule as ``streetfix localize``, with the same results."""

import json
import shutil
import subprocess
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from service.cli import localize
from service.confidence.reasons import FOCAL_FACTORS, GAIN_OF_ONE, support_of
from service.console.built import WEB
from service.errors import RequestError
from service.imaging.level import SUSPICIOUS_RATIOS, USUAL_HEIGHT_M

MODULE, RULE = WEB / "src" / "query" / "focal_length.ts", WEB / "src" / "query" / "focal_length_rule.json"
ESBUILD = WEB / "node_modules" / ".bin" / "esbuild"
#: Reads cases from standard input. A trial without an answer fails.
DRIVER = """
import { checkFocalLength, needsCheck, fittingTrial, textOf, withFocalFactor } from './focal_length.mjs';
let read = '';
for await (const part of process.stdin) read += part;
const results = [];
for (const { answer, trials, request, goesOn } of JSON.parse(read)) {
  const sent = [];
  const ask = async (factor) => {
    sent.push(withFocalFactor(request, factor));
    const found = trials[String(factor)];
    if (found === null) throw new Error('no answer');
    return found;
  };
  const check = await checkFocalLength(ask, () => goesOn);
  const told = check === null ? null : textOf(answer, check);
  const factor = check === null ? null : (fittingTrial(answer, check.trials)?.factor ?? null);
  results.push({ needs: needsCheck(answer), factor, sent, told });
}
process.stdout.write(JSON.stringify(results));
"""
REQUEST: dict[str, Any] = {
    "camera": {"width": 64, "height": 48, "fx": 30.5, "fy": 31.0, "cx": 31.5, "cy": 23.5, "height_m": 1.2},
    "depth": {"scale_m": 1},
}

Results = Callable[..., list[dict[str, Any]]]


def answer_of(
    status: str = "OUT_OF_MAP",
    *,
    inliers: float = 0.2,
    similarity: float = 0.5,
    confidence: float | None = 0.01,
    height: tuple[float, str] | None = None,
) -> dict[str, Any]:
    told = None if height is None else {"height_m": height[0], "origin": height[1]}
    hypotheses = [{"inliers": inliers, "similarity": similarity}, {"inliers": 1.0, "similarity": 1.0}]
    return {"status": status, "confidence": confidence, "hypotheses": hypotheses, "camera_height": told}


def case(
    answer: dict[str, Any], halved: dict[str, Any] | None, doubled: dict[str, Any] | None, *, goes_on: bool = True
) -> dict[str, Any]:
    return {"answer": answer, "trials": {"0.5": halved, "2": doubled}, "request": REQUEST, "goesOn": goes_on}


@pytest.fixture(scope="module")
def results_of(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Run the module of the page with Node and return its results."""
    if shutil.which("node") is None or not ESBUILD.exists():
        pytest.skip("the page's packages are not there: make check-console installs them, with Node")
    folder = tmp_path_factory.mktemp("page")
    options = ["--bundle", "--format=esm", f"--outfile={folder / 'focal_length.mjs'}", "--log-level=error"]
    subprocess.run([str(ESBUILD), str(MODULE), *options], check=True)
    (folder / "driver.mjs").write_text(DRIVER)

    def results(*cases: dict[str, Any]) -> list[dict[str, Any]]:
        done = subprocess.run(
            ["node", folder / "driver.mjs"], input=json.dumps(cases), capture_output=True, text=True, check=True
        )
        told: list[dict[str, Any]] = json.loads(done.stdout)
        return told

    return results


def test_the_numbers_are_those_of_the_code() -> None:
    assert json.loads(RULE.read_text()) == {
        "factors": list(FOCAL_FACTORS),
        "gain_nats": GAIN_OF_ONE,
        "inliers_nats": support_of(1.0, 0.0),
        "similarity_nats": support_of(0.0, 1.0),
        "usual_height_m": USUAL_HEIGHT_M,
        "suspicious_ratios": [list(ratios) for ratios in SUSPICIOUS_RATIOS],
    }, f"change {RULE} as well, then run: make console"


def test_random_answers_give_the_result_of_the_command(results_of: Results, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(5)

    def drawn() -> dict[str, Any]:
        status = str(rng.choice(["LOCALIZED", "AMBIGUOUS", "OUT_OF_MAP"]))
        height = (float(rng.uniform(0.3, 4.0)), str(rng.choice(["given", "estimated", "assumed"])))
        return answer_of(
            status,
            inliers=rng.uniform(),
            similarity=rng.uniform(0.4, 0.6),
            height=height if rng.uniform() < 0.8 else None,
        )

    def failing() -> dict[str, Any] | None:
        return None if rng.uniform() < 0.1 else drawn()

    cases = [case(drawn(), failing(), failing()) for _ in range(300)]
    expected = []
    for each in cases:

        def ask(factor: float, trials: dict[str, Any] = each["trials"]) -> dict[str, Any]:
            answer: dict[str, Any] | None = trials[f"{factor:g}"]
            if answer is None:
                raise RequestError("no answer")
            return answer

        needs = each["answer"]["status"] != "LOCALIZED" or localize._has_suspicious_height(each["answer"])
        expected.append((needs, localize._fitting_factor(each["answer"], ask)))
    assert [(each["needs"], each["factor"]) for each in results_of(*cases)] == expected
    assert {factor for _, factor in expected} == {None, 0.5, 2.0}
    assert {needs for needs, _ in expected} == {True, False}
    capsys.readouterr()


def test_only_fx_and_fy_of_the_further_queries_differ(results_of: Results) -> None:
    (found,) = results_of(case(answer_of(), answer_of(), answer_of()))
    camera = REQUEST["camera"]
    assert found["sent"] == [
        REQUEST | {"camera": camera | {"fx": factor * camera["fx"], "fy": factor * camera["fy"]}}
        for factor in FOCAL_FACTORS
    ]


def test_the_line_names_the_change_and_both_confidences(results_of: Results) -> None:
    better: dict[str, Any] = {"inliers": 0.8, "similarity": 0.6}
    halved, doubled, uncalibrated, none = results_of(
        case(answer_of(), answer_of("LOCALIZED", confidence=0.97, **better), answer_of()),
        case(answer_of(), None, answer_of("LOCALIZED", confidence=0.97, **better)),
        case(answer_of(confidence=None), answer_of(confidence=None, **better), answer_of(confidence=None)),
        case(answer_of(), answer_of(), answer_of()),
    )
    finding = "With fx and fy {}, the confidence is 97 % instead of 1 %. Check the focal length and the image size."
    assert halved["told"] == {"text": finding.format("halved"), "found": True}
    failed = " The query with fx and fy halved failed: Error: no answer."
    assert doubled["told"] == {"text": finding.format("doubled") + failed, "found": True}
    assert uncalibrated["told"]["text"].startswith("With fx and fy halved, the images fit the map better. Check")
    text = "Focal length checked: with fx and fy halved and doubled, the images do not fit the map clearly better."
    assert none["told"] == {"text": text, "found": False}


def test_a_failed_trial_differs_from_one_that_does_not_fit(results_of: Results) -> None:
    one, both = results_of(case(answer_of(), answer_of(), None), case(answer_of(), None, None))
    assert one["told"]["text"] == (
        "Focal length checked: with fx and fy halved, the images do not fit the map clearly better. "
        "The query with fx and fy doubled failed: Error: no answer."
    )
    assert both["told"]["text"] == (
        "The query with fx and fy halved failed: Error: no answer. The query with fx and fy doubled failed: Error: no answer."
    )
    assert not one["told"]["found"]
    assert not both["told"]["found"]


def test_a_later_query_ends_the_check(results_of: Results) -> None:
    (ended,) = results_of(case(answer_of(), answer_of(), answer_of(), goes_on=False))
    assert ended["told"] is None
    assert len(ended["sent"]) == 1
