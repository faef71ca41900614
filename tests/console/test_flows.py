"""What people do with the console, in a real browser against a real service; ``console.flows_passed`` counts these."""

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from benchmarks.console.browser import ANSWER_MS, click_sample, open_console
from benchmarks.console.served import Demo, other_version, serving

Pages = Callable[..., Any]
Shoot = Callable[[Any, str], None]


def files_of(demo_map: Demo, name: str) -> list[str]:
    """The files of a sample, as a user would choose them."""
    return [str(next((demo_map.samples / name).glob(f"{part}.*"))) for part in ("rgb", "depth", "request", "truth")]


#: A wide spread of positions, as an answer without a pose has it.
SPREAD = {
    "mean": {"x": 0, "y": 0, "z": 0},
    "covariance": [900.0, 0, 0, 0, 900.0, 0, 0, 0, 1],
    "heading_std_deg": 40,
    "hypotheses_weight": 0.2,
}


def refuse(page: Any, status: str, reasons: list[dict[str, Any]]) -> None:
    """Let the service's answers come without a pose."""

    def refused(route: Any) -> None:
        response = route.fetch()
        content = response.json()
        without = {"status": status, "pose": None, "street": None, "spread": SPREAD, "reasons": reasons}
        content["answer"] |= without
        route.fulfill(response=response, json=content)

    page.route("**/v1/explain", refused)


def test_a_sample_pair_is_asked_with_one_click(url: str, page_of: Pages, shoot: Shoot) -> None:
    page = page_of()
    open_console(page, url)
    click_sample(page, "01")
    assert page.inner_text(".verdict .status") == "LOCALIZED"
    assert "street 5" in page.inner_text(".verdict .street")
    assert float(page.inner_text(".verdict .figures div:nth-child(2) b").removesuffix(" m")) < 1.0
    assert page.locator(".images img").count() == 6
    widths = page.eval_on_selector_all(".images img", "images => images.map(image => image.naturalWidth)")
    assert all(width >= 64 for width in widths)
    shoot(page, "sample_light")
    page.click("button:has-text('3D')")
    shoot(page, "sample_around")


def test_ones_own_files_are_sorted_and_asked(url: str, demo_map: Demo, page_of: Pages, shoot: Shoot) -> None:
    page = page_of(dark=True)
    open_console(page, url)
    assert page.is_disabled("button.primary")
    page.set_input_files("#files", files_of(demo_map, "05"))
    page.wait_for_selector(".chosen li.given >> nth=3")
    page.click("button.primary")
    page.wait_for_selector(".verdict", timeout=ANSWER_MS)
    assert "from the ground truth" in page.inner_text(".verdict .figures")
    shoot(page, "upload_dark")


def test_an_answer_that_is_refused_says_what_to_check(url: str, page_of: Pages, shoot: Shoot) -> None:
    """Reasons in their order with their remedies; then an answer without any. Both are put in place of the service's own."""
    reasons = [
        {"check": "intrinsics", "evidence": {"similarity": -4.25}, "remedy": "compare fx and fy"},
        {"check": "baseline", "evidence": {"log_noise": 3.5, "points": -6.0}, "remedy": "check the stereo baseline"},
    ]
    page = page_of()
    open_console(page, url)
    for number, told in (("01", reasons), ("02", [])):
        refuse(page, "OUT_OF_MAP", told)
        click_sample(page, number)
        page.unroute("**/v1/explain")
        assert page.inner_text(".verdict .status").upper() == "OUT OF MAP"
        items = page.locator(".why li")
        assert items.count() == len(told)
        for k, each in enumerate(told):
            text = items.nth(k).inner_text()
            assert each["check"] in text
            assert each["remedy"] in text
    assert "outside the map" in page.inner_text(".why")
    shoot(page, "refused")
    page.unroute_all()


def test_an_answer_names_the_correction_of_its_rig(url: str, page_of: Pages) -> None:
    """The map of the demo has no correction. The name is put into the service's own answer, then taken away again."""
    page = page_of()
    open_console(page, url)
    row = page.locator("section:has(h2:text('Pose')) dl.facts div:has(dt:text-is('confidence corrected for'))")
    click_sample(page, "01")
    assert row.count() == 0

    def corrected(route: Any) -> None:
        response = route.fetch()
        content = response.json()
        content["answer"]["rig_correction"] = "<b>mule</b>"
        route.fulfill(response=response, json=content)

    page.route("**/v1/explain", corrected)
    click_sample(page, "02")
    assert row.locator("dd").inner_text() == "<b>mule</b>"  # text, not markup
    page.unroute_all()


def test_a_wrong_file_is_told_with_what_to_do(url: str, demo_map: Demo, page_of: Pages, shoot: Shoot) -> None:
    page = page_of()
    open_console(page, url)
    page.set_input_files("#files", [{"name": "notes.pdf", "mimeType": "application/pdf", "buffer": b"%PDF"}])
    page.wait_for_selector(".problem")
    assert "notes.pdf: this file is not an image" in page.inner_text(".problem")
    rgb, _, request, _ = files_of(demo_map, "05")
    damaged = {"name": "depth.png", "mimeType": "image/png", "buffer": b"\x89PNG\r\n\x1a\nnothing of the kind"}
    page.set_input_files("#files", [rgb, request])
    page.set_input_files("#files", [damaged])
    page.wait_for_selector("button.primary:not([disabled])")
    page.click("button.primary")
    page.wait_for_selector(".problem .hint", timeout=ANSWER_MS)
    assert "field depth" in page.inner_text(".problem")
    shoot(page, "wrong_file")


def test_an_ambiguous_answer_shows_its_hypotheses(url: str, page_of: Pages, shoot: Shoot) -> None:
    """The hypotheses are those of the service, the status is put in its place."""
    page = page_of()
    open_console(page, url)
    refuse(page, "AMBIGUOUS", [])
    click_sample(page, "07")
    assert page.locator(".verdict.ambiguous").count() == 1
    assert page.locator("section:has(h2:text('Hypotheses')) tbody tr").count() >= 2
    assert page.locator(".why").count() == 1
    shoot(page, "ambiguous")
    page.unroute_all()


def ask_with_other_focal_length(page: Any, demo_map: Demo, factor: float) -> None:
    """Send sample 05 with fx and fy times the factor, and wait for the answer."""
    rgb, depth, request, _ = files_of(demo_map, "05")
    page.set_input_files("#files", [rgb, depth])
    asked = json.loads(Path(request).read_text())
    asked["camera"] |= {name: factor * asked["camera"][name] for name in ("fx", "fy")}
    page.fill("#request", json.dumps(asked))
    page.click("button.primary")
    page.wait_for_selector(".verdict", timeout=ANSWER_MS)


def test_a_focal_length_off_by_a_factor_of_two_is_named(url: str, demo_map: Demo, page_of: Pages, shoot: Shoot) -> None:
    page = page_of()
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.url))
    open_console(page, url)
    click_sample(page, "05")
    page.wait_for_timeout(1000)
    assert page.inner_text(".check") == ""  # the right camera: no further query
    assert not any(each.endswith("/v1/localize") for each in sent)
    page.evaluate("document.querySelector('.verdict').remove()")
    ask_with_other_focal_length(page, demo_map, 2.0)
    page.wait_for_selector(".check.found", timeout=ANSWER_MS)
    assert page.inner_text(".check").startswith("With fx and fy halved, the ")
    assert "Check the focal length" in page.inner_text(".check")
    assert sum(each.endswith("/v1/localize") for each in sent) == 2
    shoot(page, "focal_length")


def test_a_check_of_the_focal_length_that_fails_keeps_the_answer(url: str, demo_map: Demo, page_of: Pages) -> None:
    page = page_of()
    open_console(page, url)
    busy = {"title": "Too many requests.", "code": "busy", "status": 429, "detail": "Send it again later."}
    page.route(
        "**/v1/localize",
        lambda route: route.fulfill(status=429, content_type="application/problem+json", body=json.dumps(busy)),
    )
    ask_with_other_focal_length(page, demo_map, 2.0)
    page.wait_for_selector(".check:has-text('doubled failed: Too many requests.')", timeout=ANSWER_MS)
    assert "the images" not in page.inner_text(".check")
    assert page.locator(".check.found, .problem").count() == 0
    assert page.locator(".verdict").count() == 1
    page.unroute_all()


def test_a_service_that_is_down_is_told_and_found_again(
    demo_map: Demo, page_of: Pages, shoot: Shoot, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = page_of()
    with serving(demo_map.bundle, "--samples", demo_map.samples) as (url, process):
        open_console(page, url)
        click_sample(page, "02")
        process.send_signal(signal.SIGTERM)
        process.wait(60)
        page.click("[data-sample='02']")
        page.wait_for_selector(".problem", timeout=ANSWER_MS)
        assert "cannot be reached" in page.inner_text(".problem")
        assert page.inner_text(".state") == "does not answer"
        shoot(page, "service_down")
    # The service runs again, but at another port. So the page is of another origin, which the service must allow.
    monkeypatch.setenv("STREETFIX_ALLOWED_HOSTS", "127.0.0.1")
    with serving(demo_map.bundle, "--samples", demo_map.samples) as (other, _):
        page.route(f"{url}/**", lambda route: route.continue_(url=route.request.url.replace(url, other)))
        page.click("[data-sample='02']")
        page.wait_for_selector(".verdict", timeout=ANSWER_MS)
        assert page.inner_text(".state") == "serving"


def test_a_map_is_swapped_and_rolled_back_by_those_who_may(
    demo_map: Demo, page_of: Pages, shoot: Shoot, tmp_path: Path
) -> None:
    first = json.loads((demo_map.bundle / "manifest.json").read_text())["version"]
    second = other_version(demo_map.bundle, tmp_path / "second")
    page = page_of()
    with serving(demo_map.bundle, tmp_path / "second") as (url, _):
        open_console(page, url)
        page.click("role=tab[name='Maps']")
        assert page.inner_text(".versions .serves code") == second
        page.click("button:has-text('Roll back')")
        page.wait_for_selector(f".versions .serves code:text('{first}')")
        assert f"{first} is serving now" in page.inner_text(".message")
        assert httpx.get(f"{url}/v1/maps").json()["maps"][0]["version"] == first
        page.wait_for_selector(f"[data-ready$='{first}']")
        page.click("button:has-text('Show coverage')")
        shoot(page, "map_rolled_back")
        page.click("button:has-text('Swap in')")
        page.wait_for_selector(f".versions .serves code:text('{second}')")
