# docker build --build-arg VERSION=0.1.0 -t sst-graph .      (make image gives the version from git)
# docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" sst-graph calibrate drive --out result
FROM python:3.12-slim AS build
ARG VERSION=0.1.0.dev0
# The context holds no git, so the version is given.
ENV SETUPTOOLS_SCM_PRETEND_VERSION_FOR_SST_GRAPH=$VERSION
WORKDIR /src
COPY . .
RUN python -m pip wheel --no-cache-dir --no-deps -w /wheels .

FROM python:3.12-slim
COPY --from=build /wheels /wheels
RUN set -- /wheels/*.whl \
    && python -m pip install --no-cache-dir "$1[ros,yaml,onnx]" \
    && useradd --create-home --uid 1000 calibration
# Many small matrices: threads only get in each other's way.
ENV OMP_NUM_THREADS=1 MPLCONFIGDIR=/var/cache/matplotlib
# matplotlib looks for the fonts once, here; any user may run the image.
RUN mkdir $MPLCONFIGDIR && python -c "import matplotlib.font_manager" && chmod -R a+rwX $MPLCONFIGDIR
USER calibration
WORKDIR /data
ENTRYPOINT ["sst-graph"]
CMD ["--help"]
