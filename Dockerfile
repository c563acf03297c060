# Two images from one file; compose.yaml builds both.
#   docker build --target service -t koop-service .
#   docker build --target client  -t koop-client  .
#
# On x86 the default package index serves torch with CUDA, gigabytes that a CPU never uses. For the
# CPU build of the same version pass the index that PyTorch's installation page names for CPU:
#   docker build --target service --build-arg PIP_EXTRA_INDEX_URL=<that index> -t koop-service .
# pip reads the argument by itself and prefers the build with the suffix (2.13.0+cpu) to the plain
# one; constraints.txt allows both.
ARG PYTHON_IMAGE=python:3.11-slim-bookworm

FROM ${PYTHON_IMAGE} AS base
ENV PATH=/opt/koop/bin:$PATH PYTHONUNBUFFERED=1
RUN groupadd --gid 10001 koop && useradd --uid 10001 --gid koop --create-home koop

FROM base AS build
ARG PIP_EXTRA_INDEX_URL=""
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
RUN python -m venv /opt/koop
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./

# Without the sources the first install brings the dependencies alone: a layer that lives until a
# pin changes. The second one brings koop.
FROM build AS build-service
# With psycopg for --state-store, but without Ray, the large part of koop[cluster].
RUN pip install -c constraints.txt '.[service]' 'psycopg[binary]'
COPY protocol protocol
COPY service service
COPY clients clients
RUN pip install --no-deps --force-reinstall .

FROM build AS build-client
RUN pip install -c constraints.txt '.[sim]'
COPY protocol protocol
COPY service service
COPY clients clients
RUN pip install --no-deps --force-reinstall .

FROM base AS service
COPY --from=build-service /opt/koop /opt/koop
# A named volume takes its owner from the folder in the image.
RUN install -d -o koop -g koop /var/lib/koop
# Compiled kernels: site-packages is not writable for this user.
ENV NUMBA_CACHE_DIR=/home/koop/.cache/numba
USER koop
WORKDIR /home/koop
ENTRYPOINT ["koop-serve"]

FROM base AS client
COPY --from=build-client /opt/koop /opt/koop
ENV NUMBA_CACHE_DIR=/home/koop/.cache/numba MPLBACKEND=Agg
USER koop
WORKDIR /home/koop
ENTRYPOINT ["koop-sim-client"]
