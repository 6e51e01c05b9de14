# A slim image of the command line, with GDAL from its wheel; not root.
#   docker build -t ortho-pipeline . && docker run --rm ortho-pipeline doctor
FROM python:3.13-slim AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY ortho_pipeline ortho_pipeline
COPY plugins plugins
RUN python -m venv /opt/ortho && /opt/ortho/bin/pip install --no-cache-dir '.[wheel,dask]'

FROM python:3.13-slim
RUN useradd --create-home --uid 10001 ortho && mkdir -p /cache /work /opt/numba/kernels-10001 \
 && chown ortho:ortho /cache /work /opt/numba/kernels-10001 && chmod 700 /opt/numba/kernels-10001
COPY --from=build /opt/ortho /opt/ortho
ENV PATH=/opt/ortho/bin:$PATH ORTHO_CACHE=/cache/ortho NUMBA_CACHE_DIR=/opt/numba PYTHONUNBUFFERED=1
# Compiled code of the usual job is in the image, for all processors of this kind: a new container does not compile, also
# where it runs as another user or cannot write. Root compiles it, so that all users may trust it. On ARM: --build-arg CPU=generic.
ARG CPU=x86-64-v3
ENV NUMBA_CPU_NAME=$CPU NUMBA_CPU_FEATURES=""
COPY sample_data/scene.tif sample_data/scene_RPC.TXT sample_data/dem.tif /tmp/sample/
RUN ortho rectify /tmp/sample/scene.tif --dem /tmp/sample/dem.tif --dem-vertical ellipsoid --override-dem-vertical \
        -o /tmp/warm && rm -r /tmp/warm /tmp/sample && chmod -R a+rX /opt/numba/kernels-0
USER 10001
WORKDIR /work
ENTRYPOINT ["ortho"]
