# The service alone: no torch, no compiler, no package installer in the last stage.
#   docker build -t streetfix .
#   docker run --read-only --tmpfs /tmp -p 8000:8000 -p 50051:50051 -v "$PWD/maps:/maps:ro" \
#     -v "$PWD/keys.txt:/keys.txt:ro" -e STREETFIX_API_KEYS=/keys.txt streetfix
# A container listens on all of its addresses, so it asks for API keys (streetfix keys) or client certificates; where the port is
# published to loopback or a private network alone, -e STREETFIX_INSECURE_PUBLIC=true lets it start without.

FROM python:3.11-slim AS build
WORKDIR /src
# The locked packages first: they change less often than the code.
COPY locks/service.txt locks/service.txt
RUN python -m venv --without-pip /opt/streetfix \
 && pip --python /opt/streetfix/bin/python install --no-cache-dir --only-binary :all: --require-hashes \
    --requirement locks/service.txt
# The registration kernel is C: the build brings a compiler from PyPI where the machine has none, as here.
COPY pyproject.toml hatch_build.py README.md LICENSE ./
COPY service service
COPY model_training model_training
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels . \
 && pip --python /opt/streetfix/bin/python install --no-cache-dir --no-deps --no-index /wheels/*.whl

FROM python:3.11-slim
LABEL org.opencontainers.image.title="streetfix" \
      org.opencontainers.image.description="Where is this robot? Street and pose from one RGB and one depth picture." \
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
    STREETFIX_GRPC_PORT=50051
USER 10001:10001
WORKDIR /tmp
VOLUME ["/maps"]
EXPOSE 8000 50051
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=3s --start-period=20s --retries=3 \
  CMD ["streetfix", "health"]
CMD ["streetfix", "serve", "--host", "0.0.0.0"]
