#!/usr/bin/env bash
# Maps a photo and finds it again, with nothing but curl.
#
#   examples/curl.sh http://127.0.0.1:8080 PHOTO FRAME
#
# PHOTO is stored in the map `curl`, FRAME is looked for in it. With API keys, set KEY.
set -euo pipefail
server="$1" photo="$2" frame="$3"

call() {
  # Fails with the server's own words, and tries again when it is told to come back later.
  curl --silent --show-error --fail-with-body --retry 3 \
    --header "X-API-Key: ${KEY:-}" --write-out '\n' "$@"
}

echo "== the server is ready"
call "$server/readyz"

echo "== a photo and where it was taken"
call --data-binary @"$photo" --header 'content-type: application/octet-stream' \
  "$server/references?map=curl&external_id=the-photo&lat=51.5072&lon=-0.1276&heading=270"

echo "== which place does the frame show?"
call --data-binary @"$frame" --header 'content-type: application/octet-stream' \
  "$server/query?map=curl&top_k=3&deadline_ms=20000"

echo "== why: key patches that agree"
call --form query=@"$frame" --form reference=@"$photo" "$server/match" |
  sed 's/"correspondences":\[[^]]*\]\(,[^]]*\]\)*/"correspondences":"..."/g' | cut -c 1-400

echo "== the map is deleted"
call --request DELETE "$server/maps/curl"
