# HAProxy from Debian.
ARG BASE
FROM ${BASE}
RUN apt-get update \
    && DEBIAN_FRONTEND=noninteractive apt-get install --yes --no-install-recommends haproxy \
    && rm -rf /var/lib/apt/lists/*
