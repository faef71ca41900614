# The service alone: no torch, no training, no compiler, no package installer in the last stage.
#   docker build -t streetfix .
#   docker run --read-only --tmpfs /tmp -p 8000:8000 -p 50051:50051 -v "$PWD/maps:/maps:ro" \
#     -v "$PWD/keys.txt:/keys.txt:ro" -e STREETFIX_API_KEYS=/keys.txt streetfix
# A container listens on all of its addresses, so it requires API keys (streetfix keys) or client certificates. If the port is published
# only to loopback or a private network, -e STREETFIX_INSECURE_PUBLIC=true lets it start without them.

# Both images are pinned by the digest of their multi-architecture index; a newer patch release is a change of these lines.
FROM python:3.11.16-bookworm@sha256:b99029c95d3d37fb1e4e76d287f7984373dca77c665885986e31b2c95260c13c AS build
WORKDIR /src
# The locked packages first: they change less often than the code. What builds the wheel stays in an environment of its own.
COPY locks/service.txt locks/build.txt locks/
RUN python -m venv --without-pip /opt/streetfix \
 && pip --python /opt/streetfix/bin/python install --no-cache-dir --only-binary :all: --require-hashes \
    --requirement locks/service.txt \
 && python -m venv /opt/build \
 && /opt/build/bin/pip install --no-cache-dir --only-binary :all: --require-hashes --requirement locks/build.txt
# This image's gcc builds the C code, as for the reports. From here on nothing is downloaded.
COPY pyproject.toml README.md LICENSE ./
COPY native native
COPY docker docker
COPY service service
# The service alone: maps and encoders are built elsewhere, and every map brings its encoder.
RUN PATH=/opt/build/bin:$PATH /opt/build/bin/pip wheel --no-cache-dir --no-deps --no-index --no-build-isolation \
    --config-settings wheel.packages=service --wheel-dir /wheels . \
 && pip --python /opt/streetfix/bin/python install --no-cache-dir --no-deps --no-index /wheels/*.whl \
 && install -m 755 docker/ready /opt/streetfix/bin/streetfix-ready

FROM python:3.11.16-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b
LABEL org.opencontainers.image.title="streetfix" \
      org.opencontainers.image.description="Where is this robot? Street and pose from one RGB and one depth image." \
      org.opencontainers.image.licenses="Apache-2.0"
RUN python -m pip uninstall --yes pip setuptools wheel \
 && useradd --uid 10001 --no-create-home --shell /usr/sbin/nologin streetfix \
 && mkdir /maps
COPY --from=build /opt/streetfix /opt/streetfix
ENV PATH=/opt/streetfix/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    ORT_DISABLE_TELEMETRY=1 \
    STREETFIX_MAPS=/maps \
    STREETFIX_PORT=8000 \
    STREETFIX_GRPC_PORT=50051 \
    STREETFIX_HEALTH_PORT=8001
USER 10001:10001
WORKDIR /tmp
VOLUME ["/maps"]
EXPOSE 8000 50051
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=3s --start-period=20s --retries=3 \
  CMD ["streetfix-ready"]
CMD ["streetfix", "serve", "--host", "0.0.0.0"]
