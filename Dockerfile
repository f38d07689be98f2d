# A node in a container: docker build -t sinew-node .   (docs/book/src/how-to/containers.md)
# `develop` is the image of .devcontainer: all tools of .ci/run.
FROM rust:1.95-bookworm AS develop
COPY packages/prepare /usr/local/sbin/sinew-prepare
RUN sinew-prepare develop && rustup component add rustfmt clippy && rustup target add aarch64-unknown-linux-gnu

FROM develop AS build
WORKDIR /src
COPY . .
RUN cargo build --locked --profile robot -p sinew-cli -p sinew-node \
 && mkdir /package && packages/deb target/robot/sinew target/robot/sinew-node /package

FROM debian:bookworm-slim
COPY --from=build /src/packages/prepare /package/ /package/
RUN /package/prepare node /package/sinew_*.deb && rm -r /package
USER sinew
VOLUME ["/run/sinew", "/var/lib/sinew"]
ENTRYPOINT ["/usr/bin/sinew-node"]
CMD ["/etc/sinew/node.toml"]
