#!/bin/sh
# Sees to a browser for the tests of the page: one that is there, Debian's, or Playwright's own. Those tests skip
# without one, so this never fails; each way has a deadline.
python=${1:-python3}

find_browser() {
  for name in chromium-headless-shell chromium chromium-browser google-chrome; do
    command -v "$name" && return
  done
  "$python" - <<'CODE'
import pathlib, sys
from playwright.sync_api import sync_playwright
with sync_playwright() as playwright:
    path = pathlib.Path(playwright.chromium.executable_path)
    sys.exit(0 if path.exists() else 1)
CODE
}

find_browser >/dev/null 2>&1 && exit 0
echo "Installing a browser for the tests of the page"
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
  timeout 120 apt-get update -q >/dev/null 2>&1
  DEBIAN_FRONTEND=noninteractive timeout 300 apt-get install -y -q --no-install-recommends chromium-headless-shell >/dev/null 2>&1 ||
    DEBIAN_FRONTEND=noninteractive timeout 300 apt-get install -y -q --no-install-recommends chromium >/dev/null 2>&1
fi
find_browser >/dev/null 2>&1 || timeout 300 "$python" -m playwright install --only-shell chromium >/dev/null 2>&1
find_browser >/dev/null 2>&1 || echo "No browser could be installed; the tests of the page will be skipped." >&2
exit 0
