#!/bin/sh
# One dive after another, by the settings in /data; they are written once and then yours.
set -eu
cd /data
if [ ! -e settings ]; then
    cat > settings <<'SETTINGS'
# where measurements come from, see docs/online-sources.md of rovgraph
SOURCES="waterlinked://192.168.2.95 mavlink:udpin:0.0.0.0:14551"
# further options of rovgraph online, such as --config /data/vehicle.yaml --chart /data/harbour.tif
OPTIONS="--http-origin http://192.168.2.2 --http-origin http://blueos.local"
SETTINGS
fi
. ./settings
out="dives/$(date -u +%Y%m%d-%H%M%S)"
mkdir -p dives
# shellcheck disable=SC2086 # sources and options are lists of words
exec rovgraph online $SOURCES $OPTIONS --http 0.0.0.0:8080 --http-token /data/token --out "$out" > /dev/null
