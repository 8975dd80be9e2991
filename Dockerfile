# CPU only. docker build -t shadowgraph . && docker run --rm -v "$PWD:/data" shadowgraph run my_object --viewer off
# PyTorch's CPU wheels make the image several gigabytes smaller: give their index, which its install page names,
# with --build-arg PIP_OPTIONS="--extra-index-url ...".
FROM python:3.12-slim
ARG PIP_OPTIONS=""
RUN useradd --create-home user
COPY . /src
RUN pip install --no-cache-dir $PIP_OPTIONS /src && rm -rf /src
USER user
WORKDIR /data
ENTRYPOINT ["shadowgraph"]
