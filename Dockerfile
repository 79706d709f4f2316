# finforce with ROS 2 from wheels, on Debian's Python: no other archive than Debian's and PyPI.
#   docker build -t finforce . && docker run --rm -v "$PWD/report:/report" finforce demo --report /report
FROM debian:bookworm-slim AS base
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install -y --no-install-recommends \
      ca-certificates libgl1 libgomp1 libusb-1.0-0 libx11-6 python3 python3-venv \
 && rm -rf /var/lib/apt/lists/*

# for work on finforce: what its tests, its pages and its builds need; the repository is mounted
FROM base AS dev
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install -y --no-install-recommends cmake g++ git make python3-dev \
 && rm -rf /var/lib/apt/lists/*

FROM base AS run
COPY . /src
RUN python3 -m venv /opt/finforce \
 && /opt/finforce/bin/pip install --no-cache-dir "/src[ros,mesh,can]" \
 && rm -rf /src
ENV PATH=/opt/finforce/bin:$PATH
# a user whose group owns the serial ports
RUN useradd --create-home --groups dialout finforce
USER finforce
WORKDIR /home/finforce
# in the image, so that no container has to compile
RUN finforce prepare --calibration bench
ENTRYPOINT ["finforce"]
CMD ["--help"]
