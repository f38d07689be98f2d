//! Incoming connections: the listeners, and the handling of accepted connections.

use std::{
    io,
    net::{SocketAddr, TcpListener},
    sync::{Arc, Mutex},
};

use actix::{Context, StreamHandler};
use sinew_model::address::is_same_host;
use sinew_runtime::{lock, time::Time};
use tokio::net::TcpStream;

use super::{
    super::{
        core::Input,
        link::{self, Mode},
        listener,
        shared_socket::SharedSocket,
        transport::Transport,
    },
    Gncl,
    wire::Wire,
};

impl Gncl {
    /// Returns the listeners, one per address. A restarted layer reuses the open ones.
    pub(super) fn listen(&self) -> io::Result<Vec<SharedSocket<TcpListener>>> {
        let mut kept = lock(&self.state.store.listeners);
        if kept.is_empty() {
            let config = &self.state.ctx.config;
            let listener = listener::listen_first(config)?;
            let address = listener.local_addr()?;
            let further = listener::listen_at_further(config, &self.state.store.refusals);
            self.state.ctx.listens.further.get_or_init(|| listener::addresses_of(&further));
            let ipv6 = listener::listen_at_ipv6(config, address);
            let all: Vec<_> = std::iter::once(listener).chain(further).chain(ipv6).collect();
            listener::share_backlog(&all)?;
            for at in all.iter().filter_map(|listener| listener.local_addr().ok()).filter(SocketAddr::is_ipv6)
            {
                self.state.ctx.listens.port6.get_or_init(|| at.port());
            }
            self.bind_datagrams(&all);
            *kept = all.into_iter().map(Arc::new).collect();
            self.state.ctx.listens.first.get_or_init(|| address);
        }
        kept.iter().map(SharedSocket::register).collect()
    }

    /// Returns this node's own addresses at which NDL discovers others.
    pub(super) fn own_paths(&self) -> Vec<SocketAddr> {
        self.state.ctx.ports.members().map_or_else(Vec::new, |members| members.paths())
    }

    /// Whether a connection arrived at an address of an interface that this node uses. If interfaces are
    /// selected by name, the node listens at all addresses of the host.
    fn listens_at(&self, socket: &TcpStream) -> bool {
        if self.state.ctx.config.ndl.interface.are_ipv4_addresses() {
            return true;
        }
        let Ok(local) = socket.local_addr() else { return false };
        self.own_paths().iter().any(|path| is_same_host(*path, local))
    }

    fn accepted(&mut self, socket: TcpStream, ctx: &mut Context<Self>) {
        // The connection has already ended if the system does not know its peer.
        let Ok(from) = socket.peer_addr() else { return };
        let (connection, transport) = (self.core.open(), Transport::plain(socket));
        let mode = Arc::new(Mutex::new(Mode::Handshake));
        let reading = self.reading(&mode);
        let shared = (mode, reading.last_received.clone());
        let reader = self.connection_events.add(link::read(connection, transport.clone(), reading));
        self.wires
            .insert(connection, Wire::new(Some(transport), shared, reader, self.authenticator.is_none()));
        self.input(Input::Accepted(connection, from.ip()), ctx);
    }
}

impl StreamHandler<io::Result<TcpStream>> for Gncl {
    fn handle(&mut self, accepted: io::Result<TcpStream>, ctx: &mut Context<Self>) {
        match accepted {
            Ok(socket) if !self.listens_at(&socket) => {
                let detail = format_args!("a connection to {:?}", socket.local_addr());
                self.state.store.refusals.count(Time::now(), "connection over another interface", &detail);
            }
            Ok(socket) => self.accepted(socket, ctx),
            Err(error) => {
                self.state.store.refusals.count(Time::now(), "not accepted", &error);
                if listener::is_starved(&error) {
                    self.input(Input::Starved, ctx);
                }
            }
        }
    }
}
