# Three images, each with only the parts of the project that it needs:
#
#   edge    a device on a serial line: no chain client, no HTTP server except for metrics
#   server  router, provider, agent, person, operator, bridge, page (the default)
#   chain   a server with anvil, and the script that makes the site of the demonstration
#
# The base needs Python 3.11 or later with its venv module (Debian: python3, python3-venv, ca-certificates).
ARG BASE=python:3.13-slim-bookworm
# The image that provides /usr/local/bin/anvil.
ARG FOUNDRY=ghcr.io/foundry-rs/foundry:v1.7.1

FROM ${FOUNDRY} AS foundry

# pip stays in the build stages: the environment that is copied from them has none.
FROM ${BASE} AS tools
WORKDIR /source
COPY requirements/lock.txt requirements/
RUN python3 -m venv /tools && python3 -m venv --without-pip /opt/aira \
 && sed -n '/^setuptools==/,/[^\\]$/p' requirements/lock.txt > /tmp/setuptools.txt \
 && /tools/bin/pip install --quiet --no-cache-dir --no-deps --require-hashes -r /tmp/setuptools.txt

FROM tools AS project
COPY LICENSE README.md pyproject.toml ./
COPY schemas schemas
COPY mesh mesh
COPY bridges bridges
# The header of boards, which `aira new device` writes.
COPY examples/firmware/AiraFrames/src examples/firmware/AiraFrames/src
RUN /tools/bin/pip wheel --quiet --no-deps --no-build-isolation --wheel-dir /wheels .

FROM tools AS edge-environment
COPY requirements/edge.txt requirements/
RUN /tools/bin/pip --python /opt/aira/bin/python install --quiet --no-cache-dir --no-deps --require-hashes -r requirements/edge.txt
COPY --from=project /wheels /wheels
RUN /tools/bin/pip --python /opt/aira/bin/python install --quiet --no-cache-dir --no-index --no-deps /wheels/*.whl

FROM tools AS server-environment
COPY requirements/server.txt requirements/
RUN /tools/bin/pip --python /opt/aira/bin/python install --quiet --no-cache-dir --no-deps --require-hashes -r requirements/server.txt
COPY --from=project /wheels /wheels
RUN /tools/bin/pip --python /opt/aira/bin/python install --quiet --no-cache-dir --no-index --no-deps /wheels/*.whl

# A volume created at one of these folders belongs to the image's user.
FROM ${BASE} AS runtime
RUN groupadd --gid 10001 aira \
 && useradd --uid 10001 --gid aira --no-create-home --home-dir /var/lib/aira --shell /usr/sbin/nologin aira \
 && install -d -o aira -g aira -m 0700 /var/lib/aira /secrets
ENV PATH=/opt/aira/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    AIRA_DATA_DIR=/var/lib/aira
LABEL org.opencontainers.image.title="AIRA mesh" \
      org.opencontainers.image.description="A market of work between robots and people" \
      org.opencontainers.image.licenses="Apache-2.0"
WORKDIR /var/lib/aira
USER 10001:10001
CMD ["aira", "--help"]

FROM runtime AS edge
COPY --from=edge-environment /opt/aira /opt/aira

FROM runtime AS with-server
COPY --from=server-environment /opt/aira /opt/aira

FROM with-server AS chain
USER root
RUN install -d -o aira -g aira -m 0700 /chain /site \
 && for one in authority router router-north router-south provider agent validator edge bridge page person operator; do \
        install -d -o aira -g aira -m 0700 "/site/$one"; \
    done
COPY --from=foundry /usr/local/bin/anvil /usr/local/bin/anvil
COPY --chmod=0755 deploy/compose/make-site.sh /usr/local/bin/make-site
USER 10001:10001

# The last stage is the default target.
FROM with-server AS server
