# hybridlio with what the README's `make demo` and `make test` install.
#   docker build -t hybridlio .
#   docker run --rm -v "$PWD:/data" hybridlio hybridlio odometry /data/DRIVE -o /data/run
FROM python:3.11-slim-bookworm

# The system libraries are those of scripts/system-libraries.sh, which then finds them and installs nothing.
# hadolint ignore=DL3008  (a pinned version goes from the mirrors with the next update)
RUN apt-get update \
    && apt-get install -y --no-install-recommends make libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /hybridlio
COPY . .

# What the first `make` does: an environment in .venv with the tested versions. Then a demo, which fails the build if
# anything is missing.
ENV PATH=/hybridlio/.venv/bin:$PATH PIP_NO_CACHE_DIR=1 MPLBACKEND=Agg
RUN make demo DEMO=/tmp/demo DEMO_SECONDS=4 && rm -rf /tmp/demo

CMD ["hybridlio", "--help"]
