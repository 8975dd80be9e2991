# CPU only.
#   docker build -t shadowgraph .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" shadowgraph run my_object --viewer off
# The page of a run, for this machine's browser alone; the address that it prints has the token that it asks for:
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" -p 127.0.0.1:8080:8080 --hostname localhost \
#     shadowgraph view runs/my_object --host 0.0.0.0
# PyTorch's CPU wheels make the image several gigabytes smaller: give their index, which its install page names,
# with --build-arg PIP_OPTIONS="--extra-index-url ...".
FROM python:3.11-slim AS wheel
COPY . /src
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheel /src

FROM python:3.11-slim
ARG PIP_OPTIONS=""
# The versions with which all checks passed, by the lock, and none that contradict each other.
RUN --mount=type=bind,from=wheel,source=/wheel,target=/wheel --mount=type=bind,from=wheel,source=/src/requirements-ci.txt,target=/lock.txt \
    pip install --no-cache-dir $PIP_OPTIONS -c /lock.txt /wheel/*.whl && pip check
# Whoever it runs as: compiled kernels need a place that can be written.
ENV NUMBA_CACHE_DIR=/tmp/numba
RUN useradd --create-home user
USER user
WORKDIR /data
ENTRYPOINT ["shadowgraph"]
CMD ["--help"]
