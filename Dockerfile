# The main job in a container: docker build -t gridreg . && docker run --rm -v "$PWD/outputs:/home/user/outputs" gridreg
FROM python:3.12-slim
RUN useradd --create-home user
USER user
WORKDIR /home/user
COPY --chown=user . source
# Where no GPU is wanted, the CPU wheel of torch saves gigabytes: pass its index as --build-arg TORCH_INDEX=...
ARG TORCH_INDEX=
RUN python -m venv .venv \
    && .venv/bin/pip install --no-cache-dir -q ${TORCH_INDEX:+--extra-index-url "$TORCH_INDEX"} -c source/constraints.txt './source[train]'
ENTRYPOINT [".venv/bin/gridreg"]
CMD ["train", "--out", "outputs/builtin-quick"]
