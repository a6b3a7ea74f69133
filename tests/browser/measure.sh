#!/usr/bin/env bash
# Figures of the page before `gv3 serve`, in a browser that draws in software: first paint, size of the bundle, pictures a
# second of a replay, memory over so many minutes. Leave the machine to it.
#   tests/browser/measure.sh [MINUTES]
set -euo pipefail
export GV3_MEASURE_MINUTES=${1:-10}
exec "$(dirname "$0")/run.sh" --project=measure
