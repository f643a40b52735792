# DeepDetect in a container, for the processor:
#
#   docker build -t deepdetect .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/photos" deepdetect match left.jpg right.jpg
#
# The wheel is built from this checkout. What numba compiles is compiled here, once, so that no run
# waits for it. docs/installation.md says more.
ARG PYTHON=3.13

FROM python:${PYTHON}-slim AS build
WORKDIR /source
COPY . .
RUN pip install --no-cache-dir "build>=1.2" \
    && python -m build --wheel --outdir /wheels

FROM python:${PYTHON}-slim
# scikit-image brings two photographs to compile with, below.
ARG EXTRAS=app
ENV NUMBA_CACHE_DIR=/opt/deepdetect/numba \
    PYTHONDONTWRITEBYTECODE=1
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir "$(ls /wheels/*.whl)[${EXTRAS}]" scikit-image \
    && rm -r /wheels \
    && useradd --create-home --uid 1000 deepdetect \
    && install -d -o deepdetect /opt/deepdetect/numba /photos
USER 1000
WORKDIR /photos
# The demonstration matches a scene with depth, the self-test of doctor a plane. Whoever runs the
# container may read and extend what is compiled.
RUN deepdetect doctor \
    && deepdetect demo -o /tmp/demo \
    && rm -r /tmp/demo \
    && chmod -R a+rwX /opt/deepdetect/numba
ENTRYPOINT ["deepdetect"]
CMD ["--help"]
