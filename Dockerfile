# mien in a container: `docker build -t mien .`, then `docker run --rm -v "$PWD:/work" mien create me.mp4 --out out/me`.
# Without a GPU by default. With one: `docker build --build-arg TORCH=cuda -t mien-cuda .`, and `docker run --gpus all`.
ARG PYTHON=3.12
FROM python:${PYTHON}-slim-bookworm AS build
RUN apt-get update && apt-get install -y --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY requirements/uv.txt requirements/
RUN pip install --no-cache-dir --require-hashes -r requirements/uv.txt
COPY . .
# The overrides leave out what mediapipe declares and never needs (requirements/overrides.txt).
# TORCH=cpu takes torch from PyTorch's own index; TORCH=cuda takes the one of the package index, with NVIDIA's libraries.
ARG TORCH=cpu
RUN python -m venv /opt/mien \
 && if [ "$TORCH" = cpu ]; then BACKEND="--torch-backend cpu"; fi \
 && uv build --wheel --out-dir /wheels . \
 && VIRTUAL_ENV=/opt/mien uv pip install --no-cache $BACKEND --overrides requirements/overrides.txt \
      "$(ls /wheels/*.whl)[create,viewer]" "opencv-python-headless>=4.12" \
 && if [ "$TORCH" = cuda ]; then VIRTUAL_ENV=/opt/mien uv pip install --no-cache gsplat==1.5.3; fi

FROM python:${PYTHON}-slim-bookworm
COPY --from=build /opt/mien /opt/mien
ENV PATH=/opt/mien/bin:$PATH MIEN_CACHE=/cache MPLCONFIGDIR=/cache
RUN useradd --create-home mien && mkdir -p /work /cache && chown mien /work /cache
USER mien
WORKDIR /work
ENTRYPOINT ["mien"]
CMD ["--help"]
