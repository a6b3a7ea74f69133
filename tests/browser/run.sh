#!/usr/bin/env bash
# The page in a headless browser: against `gv3 serve` on the simulated rig, and against the mock daemon for what cannot
# be broken on purpose in a daemon. `--short` runs each test once, for at most four minutes; other arguments go to
# `playwright test`.
#   GV3_BIN       the gv3 to test; built (cargo, profile dev) when not given
#   GV3_CHROMIUM  the browser; else chromium, chromium-browser or google-chrome from the path
#   GV3_SCREENSHOTS=1 also writes daemon/web/screenshots
set -euo pipefail
cd "$(dirname "$0")"
web=../../daemon/web

if [ "${1:-}" = --short ]; then
    export GV3_BROWSER_SHORT=1
    shift
fi

skip() {
    echo "browser tests skipped: $1"
    exit 0
}

command -v node >/dev/null || skip "node is not here (20.19 or newer)"
command -v npm >/dev/null || skip "npm is not here"
if [ -z "${GV3_CHROMIUM:-}" ]; then
    for name in chromium chromium-browser google-chrome; do
        GV3_CHROMIUM=$(command -v "$name") && break
    done
fi
[ -x "${GV3_CHROMIUM:-}" ] || skip "no chromium here; name one in GV3_CHROMIUM"
export GV3_CHROMIUM

[ -d "$web/node_modules" ] || npm ping >/dev/null 2>&1 || skip "the page's packages are not here, and no registry answers"
[ -d "$web/node_modules" ] || (cd "$web" && npm ci --no-audit --no-fund)
# Tests find the packages where the page has them.
ln -sfn "$web/node_modules" node_modules
(cd "$web" && npx tsc --noEmit && npx prettier --check --log-level warn . && node scripts/check_dist.mjs && npx vitest run)

if [ -z "${GV3_BIN:-}" ]; then
    (cd ../.. && cargo build --locked -p gv3 --bin gv3)
    GV3_BIN=${CARGO_TARGET_DIR:-$PWD/../../target}/debug/gv3
fi
export GV3_BIN
exec npx playwright test --config playwright.config.ts "$@"
