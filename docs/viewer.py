"""Take a picture of the viewer: python docs/viewer.py (needs Chromium and the extras `viewer` and `test`)."""

import shutil
from pathlib import Path

from playwright.sync_api import sync_playwright

from tca_envs.viewer.server import Viewer

SEED, STEPS = 35, 57
"""Seed of the episode and number of steps, after which the arm, bent and hot, carries the object to its goal."""
WITHOUT_A_GRAPHICS_CARD = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def main() -> None:
    """Write docs/viewer.png."""
    path, viewer = Path(__file__).with_suffix(".png"), Viewer(port=0)
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", *WITHOUT_A_GRAPHICS_CARD]
        )
        page = chromium.new_page(viewport={"width": 1400, "height": 900})
        page.goto(viewer.url)
        page.get_by_role("button", name="Pause").click()
        page.get_by_role("button", name="PickAndPlace").click()
        page.get_by_role("button", name="scripted").click()
        page.get_by_label("Seed").first.fill(str(SEED))
        page.get_by_role("button", name="Reset").click()
        for note in page.locator(".mantine-Notification-closeButton").all():  # of viser: there is no graphics card
            note.click()
        for _ in range(STEPS):
            page.get_by_role("button", name="Step by 0.1 s").click()
        page.locator('[data-reading="time"]', has_text=f"{STEPS / 10:.1f} s").wait_for()
        page.mouse.move(700, 850)
        page.wait_for_timeout(3000)
        page.screenshot(path=path)
        chromium.close()
    viewer.stop()
    print(f"wrote {path.name}")


if __name__ == "__main__":
    main()
