"""Make the pictures of these pages with the tool itself: `python docs/pictures.py` (needs playwright and Chromium)."""

from __future__ import annotations

import csv
import re
import shutil
import subprocess
import sys
import tempfile
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
from playwright.sync_api import Browser, sync_playwright

HERE = Path(__file__).parent
SAMPLE = Path(str(resources.files("visfuse_cli.apps.sample")))
TOOL = (sys.executable, "-m", "visfuse_cli")


def main() -> None:
    """Run the demo, open its report, pick its points; what is seen becomes calibration, report and picker pictures."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        demo = Path(folder) / "demo"
        subprocess.run([*TOOL, "demo", "--out", str(demo), "--quiet"], check=True)
        cv2.imwrite(str(HERE / "calibration.jpg"), cv2.imread(str(demo / "H.png")), [cv2.IMWRITE_JPEG_QUALITY, 82])
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        picture_report(browser, demo / "run" / "report.html")
        picture_picker(browser, Path(folder) / "H.json")
        browser.close()


def picture_report(browser: Browser, page: Path) -> None:
    """The upper part of the demo's report, a vehicle chosen."""
    window = browser.new_page(viewport={"width": 1280, "height": 1040})
    window.goto(page.as_uri())
    window.locator("tr[data-seek]").nth(2).click()
    window.wait_for_timeout(1500)
    window.screenshot(path=HERE / "report.jpg", type="jpeg", quality=80)


def picture_picker(browser: Browser, out: Path) -> None:
    """The sample's surveyed points clicked and typed, the loupe over one of them."""
    clip = SAMPLE / "clip.mp4"
    command = [*TOOL, "calibrate-homography", "--pick", str(clip), "--out", str(out)]
    server = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        address = re.search(r"http://\S+", server.stderr.readline() if server.stderr else "")
        assert address
        window = browser.new_page(viewport={"width": 1280, "height": 760})
        window.goto(address[0])
        window.wait_for_selector("#verdict:has-text('four points')")
        window.uncheck("#snap")
        with open(SAMPLE / "points.csv", newline="", encoding="utf-8") as file:
            points = [{name: float(text) for name, text in row.items()} for row in csv.DictReader(file)]
        for number, point in enumerate(points, 1):
            window.mouse.click(*place(window, point))
            field = window.locator(f"#table tbody tr:nth-child({number}) input")
            field.nth(2).fill(f"{point['X']:g}")
            field.nth(3).fill(f"{point['Y']:g}")
        window.wait_for_selector("#verdict.good")
        window.mouse.move(*place(window, points[4]))
        window.wait_for_timeout(600)
        window.screenshot(path=HERE / "picker.jpg", type="jpeg", quality=80)
    finally:
        server.terminate()
        server.wait()


def place(window: Any, point: dict[str, float]) -> tuple[float, float]:
    """Where an image point is on the screen, while the whole frame is shown."""
    box = window.locator("#view").bounding_box()
    size = cv2.imread(str(HERE / "calibration.jpg")).shape[1::-1]
    zoom = min(box["width"] / size[0], box["height"] / size[1])
    left, top = ((size[k] - box[side] / zoom) / 2 - 0.5 for k, side in enumerate(("width", "height")))
    return box["x"] + (point["u"] - left) * zoom, box["y"] + (point["v"] - top) * zoom


if __name__ == "__main__":
    main()
