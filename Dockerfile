# The program `aviary` on Debian 12, with EGL and OSMesa for rendering without a display.
#
#   docker build -t aviary .
#   docker run --rm -v "$PWD/out:/out" aviary fly --task hover --out /out/hover --gif /out/hover.gif

FROM debian:12 AS build
RUN apt-get update \
    && apt-get install -y --no-install-recommends ca-certificates curl g++ libclang-dev libmujoco-dev \
    && rm -rf /var/lib/apt/lists/*
RUN curl --proto '=https' --tlsv1.2 -sSf https://sh.rustup.rs | sh -s -- -y --profile minimal
ENV PATH=/root/.cargo/bin:$PATH
WORKDIR /src
COPY . .
RUN cargo build --release --locked -p cli

FROM debian:12
# the shared library of the version that the program was built for
RUN apt-get update \
    && apt-get install -y --no-install-recommends ffmpeg libegl1 libgl1-mesa-dri libmujoco2.2.2 libosmesa6 \
        libx11-6 libx11-xcb1 libxcursor1 libxi6 libxkbcommon-x11-0 \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /src/target/release/aviary /usr/local/bin/aviary
COPY --from=build /src/assets/policies /usr/local/share/aviary/policies
RUN aviary doctor
WORKDIR /out
ENTRYPOINT ["aviary"]
CMD ["--help"]
