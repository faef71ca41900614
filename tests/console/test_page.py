"""The page for everybody: keyboard, keys, small screens, the accessibility checker, no other host."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from benchmarks.console.browser import ANSWER_MS, AXE, DESKTOP, LAPTOP, PHONE, click_sample, open_console, serious
from benchmarks.console.served import Demo, serving
from service.maps.manifest import FILE, read_manifest
from service.runtime.keys import hash_of

Pages = Callable[..., Any]
Shoot = Callable[[Any, str], None]


@pytest.mark.skipif(not AXE.exists(), reason="axe-core is not there: npm install in service/console/web")
@pytest.mark.parametrize("size", [DESKTOP, LAPTOP, PHONE], ids=["desktop", "laptop", "phone"])
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_axe_finds_nothing_serious(url: str, page_of: Pages, shoot: Shoot, size: tuple[int, int], dark: bool) -> None:
    page = page_of(size=size, dark=dark)
    open_console(page, url)
    assert serious(page) == []
    click_sample(page, "03")
    assert serious(page) == []
    shoot(page, f"page_{size[0]}_{'dark' if dark else 'light'}")
    for tab in ("Maps", "Live"):
        page.click(f"role=tab[name='{tab}']")
        page.wait_for_timeout(300)
        assert serious(page) == []


def test_no_other_host_is_asked_for_anything(url: str, page_of: Pages) -> None:
    page = page_of()
    hosts: set[str] = set()
    page.on("request", lambda request: hosts.add(urlsplit(request.url).netloc))
    open_console(page, url)
    click_sample(page, "01")
    assert hosts - {""} == {urlsplit(url).netloc}


def test_nothing_lies_beyond_the_edge_of_a_small_screen(url: str, page_of: Pages) -> None:
    page = page_of(size=PHONE)
    open_console(page, url)
    click_sample(page, "03")
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE[0]


def test_everything_can_be_done_by_keyboard(url: str, page_of: Pages) -> None:
    page = page_of()
    open_console(page, url)
    page.focus("[data-sample='04']")
    page.keyboard.press("Enter")
    page.wait_for_selector(".verdict")
    page.focus(".map-surface")
    for key in ("ArrowLeft", "ArrowUp", "+", "-", "0", "3"):
        page.keyboard.press(key)
    assert page.get_attribute("button:text-is('3D')", "aria-pressed") == "true"
    page.focus("role=tab[name='Query']")
    page.keyboard.press("ArrowRight")
    assert page.get_attribute("role=tab[name='Maps']", "aria-selected") == "true"


def test_a_prior_is_drawn_with_the_mouse_and_asked(url: str, page_of: Pages, shoot: Shoot) -> None:
    page = page_of(permissions=["clipboard-read", "clipboard-write"])
    open_console(page, url)
    click_sample(page, "02")
    page.click("summary")
    page.click("button:text-is('Draw on the map')")
    box = page.locator(".map-surface").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2 + 120, box["y"] + box["height"] / 2, steps=4)
    page.mouse.up()
    assert float(page.input_value("#prior-std")) > 5
    assert page.get_attribute("button:text-is('Draw on the map')", "aria-pressed") == "false"
    page.click("button:text-is('Copy as curl')")
    page.wait_for_function('() => navigator.clipboard.readText().then(text => text.includes(\'"prior":{"position"\'))')
    page.evaluate("document.querySelector('.verdict').remove()")
    page.click("button.primary")
    page.wait_for_selector(".verdict", timeout=ANSWER_MS)
    shoot(page, "prior")


def test_a_question_is_copied_as_curl_and_as_python(url: str, page_of: Pages) -> None:
    page = page_of(permissions=["clipboard-read", "clipboard-write"])
    open_console(page, url)
    click_sample(page, "01")
    page.click("button:text-is('Copy as curl')")
    page.wait_for_function("() => document.body.innerText.includes('Copied.')")
    curl = page.evaluate("navigator.clipboard.readText()")
    assert curl.startswith("curl -F 'rgb=@rgb.jpg'")
    assert curl.endswith(f"'{url}/v1/localize'")
    page.click("button:text-is('as Python')")
    page.wait_for_function("() => navigator.clipboard.readText().then(text => text.includes('import httpx'))")
    compile(page.evaluate("navigator.clipboard.readText()"), "copied.py", "exec")


def test_only_the_samples_of_the_open_map_are_offered(demo_map: Demo, page_of: Pages, tmp_path: Path) -> None:
    other = shutil.copytree(demo_map.bundle, tmp_path / "west", copy_function=os.link)
    renamed = read_manifest(demo_map.bundle).model_copy(update={"name": "west"}).stamped()
    (other / FILE).unlink()  # a hard link: keep the original
    (other / FILE).write_bytes(renamed.to_bytes())
    samples = shutil.copytree(demo_map.samples, tmp_path / "samples")
    for folder in samples.iterdir():
        request = json.loads((folder / "request.json").read_text())
        name = "west" if folder.name == "01" else read_manifest(demo_map.bundle).name
        (folder / "request.json").write_text(json.dumps(request | {"map": name}))
    page = page_of()
    with serving(demo_map.bundle, other, "--samples", samples) as (url, _):
        open_console(page, url)
        for name, offers in ((read_manifest(demo_map.bundle).name, False), ("west", True)):
            page.select_option("select[aria-label='Map']", name)
            page.wait_for_selector(f"[data-ready^='{name}@']")
            assert (page.locator("[data-sample='01']").count(), page.locator("[data-sample='02']").count()) == (
                offers,
                not offers,
            )
        click_sample(page, "01")
        assert page.inner_text(".verdict .status") == "LOCALIZED"


def test_a_key_opens_what_it_may_and_no_more(demo_map: Demo, page_of: Pages, shoot: Shoot, tmp_path: Path) -> None:
    keys = tmp_path / "keys.txt"
    keys.write_text(f"robot {hash_of('plain-key')}\nchief {hash_of('high-key')} operator\n")
    config = tmp_path / "settings.toml"
    config.write_text(f"api_keys = {json.dumps(str(keys))}\n")
    page = page_of()
    with serving(demo_map.bundle, "--samples", demo_map.samples, "--config", config) as (url, _):
        page.goto(f"{url}/console/")
        page.wait_for_selector(".problem")
        assert page.inner_text(".state") == "needs an API key"
        page.fill("#key", "plain-key")
        page.press("#key", "Enter")
        page.wait_for_selector("[data-ready]")
        click_sample(page, "01")
        page.click("role=tab[name='Live']")
        page.wait_for_selector(".message.bad:has-text('operator')")
        page.fill("#key", "high-key")
        page.press("#key", "Enter")
        page.wait_for_selector("button[aria-label^='Show answer']")
        shoot(page, "live")
        assert page.evaluate("[localStorage.length, document.cookie]") == [0, ""]
