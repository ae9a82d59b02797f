"""What the tests of pages share: whether a page can be read, whatever shows it."""

from __future__ import annotations

from pathlib import Path

from playwright.sync_api import Browser, Page

PHONE = {"width": 390, "height": 844}
DESK = {"width": 1280, "height": 900}

# What reaches beyond the screen's right edge, or beyond the picture that cuts it off, and letters that nobody can read.
UNSEEN = """(smallest) => {
  const seen = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const node = walker.currentNode, parent = node.parentElement;
    if (!node.textContent.trim() || parent.closest('script, style, title, .unseen, thead')) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    const box = range.getBoundingClientRect();
    if (!box.width || getComputedStyle(parent).visibility === 'hidden') continue;
    const svg = parent.ownerSVGElement;
    const edge = svg ? svg.getBoundingClientRect().right : document.documentElement.clientWidth;
    const size = parseFloat(getComputedStyle(parent).fontSize) * (svg ? parent.getScreenCTM().a : 1);
    const text = node.textContent.trim().slice(0, 60);
    if (box.right > edge + 3) seen.push(`cut off by ${Math.round(box.right - edge)} px: ${text}`);
    if (size < smallest && !parent.closest('.drawn')) seen.push(`letters of ${size.toFixed(1)} px: ${text}`);
  }
  return seen;
}"""


def opened(browser: Browser, path: Path, viewport: dict[str, int], scheme: str) -> tuple[Page, list[str]]:
    """The page, and a list of what goes wrong in it."""
    page = browser.new_context(viewport=viewport, color_scheme=scheme).new_page()
    wrong: list[str] = []
    address = path.resolve().as_uri()
    page.on("console", lambda message: wrong.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: wrong.append(f"error: {error}"))
    page.on("request", lambda asked: wrong.append(f"asks for {asked.url}") if asked.url != address else None)
    page.goto(address)
    return page, wrong


def check(browser: Browser, path: Path) -> None:
    """The page on a phone and on a desk, by day and by night."""
    for viewport in (PHONE, DESK):
        for scheme in ("light", "dark"):
            page, wrong = opened(browser, path, viewport, scheme)
            for y in range(100, 800, 100):  # What answers to the pointer does.
                page.mouse.move(200, y)
            assert not wrong, wrong
            wide = page.evaluate("document.documentElement.scrollWidth")
            assert wide <= viewport["width"], f"{path.name} scrolls sideways: {wide} px"
            assert page.evaluate(UNSEEN, 9.5) == [], f"{path} at {viewport['width']} px"
            assert page.title(), path
            page.context.close()
