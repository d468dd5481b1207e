# rovgraph for a vehicle's computer or the topside one, amd64 and arm64:
#
#   docker build -t rovgraph .
#   docker run --rm -it --network host --user "$(id -u):$(id -g)" --stop-timeout 600 -v "$PWD:/data" rovgraph \
#       online waterlinked://192.168.2.95 mavlink:udpin:0.0.0.0:14551 --config dive1.yaml --out dive1
#
# --network host gives the container the host's ports; a serial port needs --device and --group-add dialout too.
# `docker stop` ends the recording, which is then smoothed; without --stop-timeout it has 10 s for that.
# Kernels are compiled for the processor that builds the image. On another one each start compiles for some minutes,
# unless `-v rovgraph-kernels:/var/cache/rovgraph` keeps what was compiled; --read-only needs that volume, too.
FROM python:3.13-slim

ENV ROVGRAPH_CACHE_DIR=/var/cache/rovgraph MPLCONFIGDIR=/var/cache/rovgraph PYTHONUNBUFFERED=1
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY rovgraph rovgraph
RUN pip install --no-cache-dir '.[online]'

WORKDIR /data
RUN mkdir -p "$ROVGRAPH_CACHE_DIR" \
    && rovgraph simulate circle --duration 40 --out /tmp/dive \
    && rovgraph online file:/tmp/dive/log.csv --speed max --config /tmp/dive/config.yaml --out /tmp/dive/live \
    && rm -rf /tmp/dive /src \
    && chmod -R a+rwX "$ROVGRAPH_CACHE_DIR"
ENTRYPOINT ["rovgraph"]
CMD ["--help"]
