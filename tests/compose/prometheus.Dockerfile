# Prometheus from Debian, started the way the public image starts it.
ARG BASE
FROM ${BASE}
RUN apt-get update \
    && DEBIAN_FRONTEND=noninteractive apt-get install --yes --no-install-recommends prometheus \
    && rm -rf /var/lib/apt/lists/* \
    && install --directory --owner=65534 --group=65534 /prometheus
WORKDIR /prometheus
ENTRYPOINT ["prometheus"]
