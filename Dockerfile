# One image for every service of the garden; the command says which. `make test-compose` builds and runs it.
ARG PYTHON=3.11

FROM python:${PYTHON}-slim AS build
ENV SSL_CERT_FILE=/etc/ssl/certs/ca-certificates.crt \
    UV_COMPILE_BYTECODE=1 \
    UV_LINK_MODE=copy \
    UV_NO_CACHE=1 \
    UV_PROJECT_ENVIRONMENT=/opt/garden \
    UV_PYTHON_DOWNLOADS=never \
    NUMBA_CACHE_DIR=/opt/numba \
    NUMBA_CPU_NAME=generic
WORKDIR /src
RUN pip install --no-cache-dir "uv>=0.9,<1"
COPY pyproject.toml uv.lock README.md LICENSE ./
RUN uv sync --frozen --no-install-project --extra discovery
COPY core core
COPY hw hw
COPY sim sim
COPY plant_service plant_service
COPY robot_service robot_service
COPY console console
COPY lab lab
COPY scenarios scenarios
RUN uv sync --frozen --no-editable --extra discovery
WORKDIR /
RUN mkdir -p /opt/numba \
    && /opt/garden/bin/python -m console.warm \
    && find /opt/garden -name tests -path "*/site-packages/*" -type d -prune -exec rm -r {} + \
    && chmod -R a+rwX /opt/numba

FROM python:${PYTHON}-slim
RUN useradd --uid 10001 --no-create-home --shell /usr/sbin/nologin garden \
    && mkdir -p /data /keys /run/robot \
    && chown garden:garden /data /keys /run/robot
COPY --from=build /opt/garden /opt/garden
COPY --from=build --chown=10001:10001 /opt/numba /opt/numba
ENV PATH=/opt/garden/bin:$PATH \
    GARDEN_DATA=/data \
    NUMBA_CACHE_DIR=/opt/numba \
    NUMBA_CPU_NAME=generic \
    OMP_NUM_THREADS=1 \
    OPENBLAS_NUM_THREADS=1 \
    PYTHONUNBUFFERED=1
WORKDIR /data
USER 10001:10001
CMD ["garden", "--help"]
