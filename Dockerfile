# A slim image of the command line, with GDAL from its wheel; not root.
#   docker build -t ortho-pipeline . && docker run --rm ortho-pipeline doctor
# `make pin-image` pins the base image by its digest; the packages have the versions and hashes of tools/constraints.txt.
ARG BASE=python:3.13-slim
FROM ${BASE} AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY tools/constraints.txt tools/requirements.py tools/
RUN python -m venv /opt/ortho && sed -n '/^pip==/,/# via/p' tools/constraints.txt > /tmp/pip.txt \
 && /opt/ortho/bin/pip install --no-cache-dir --require-hashes -r /tmp/pip.txt \
 && python tools/requirements.py wheel dask > /tmp/requirements.txt \
 && /opt/ortho/bin/pip install --no-cache-dir --require-hashes -c tools/constraints.txt -r /tmp/requirements.txt
COPY ortho_pipeline ortho_pipeline
COPY plugins plugins
RUN /opt/ortho/bin/pip install --no-cache-dir --no-deps --build-constraint tools/constraints.txt .

FROM ${BASE}
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
