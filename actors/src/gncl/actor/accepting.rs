//! Who connects to this node: where it listens, and what is done with a connection that was accepted.

use std::{
    io,
    net::{SocketAddr, TcpListener},
    sync::{Arc, Mutex},
};

use actix::{Context, StreamHandler};
use sinew_runtime::time::Time;
use tokio::net::TcpStream;

use super::{
    super::{
        core::Input,
        lent::Lent,
        link::{self, Mode},
        listener,
        transport::Transport,
    },
    Gncl,
    wire::Wire,
};
use crate::{ndl, stores::lock};

impl Gncl {
    /// The listeners, one for each address: those that are open already, if this layer was restarted.
    pub(super) fn listen(&self) -> io::Result<Vec<Lent<TcpListener>>> {
        let mut kept = lock(&self.stores.gncl.listeners);
        if kept.is_empty() {
            let config = &self.stores.config;
            let listener = listener::listen_first(config)?;
            let address = listener.local_addr()?;
            let further = listener::listen_at_further(config, &self.stores.gncl.refusals);
            self.stores.gncl_further.get_or_init(|| listener::addresses_of(&further));
            let ipv6 = listener::listen_at_ipv6(config, address);
            let all: Vec<_> = std::iter::once(listener).chain(further).chain(ipv6).collect();
            listener::share_backlog(&all)?;
            for at in all.iter().filter_map(|listener| listener.local_addr().ok()).filter(SocketAddr::is_ipv6)
            {
                self.stores.gncl_port6.get_or_init(|| at.port());
            }
            self.bind_datagrams(&all);
            *kept = all.into_iter().map(Arc::new).collect();
            self.stores.gncl_listen.get_or_init(|| address);
        }
        kept.iter().map(Lent::of).collect()
    }

    /// Whether a connection came to an address of an interface that this node uses: where those are chosen by their names, it listens at
    /// all that the host has.
    fn listens_at(&self, socket: &TcpStream) -> bool {
        if self.stores.config.ndl.interface.are_ipv4_addresses() {
            return true;
        }
        let Ok(local) = socket.local_addr() else { return false };
        lock(&self.stores.ndl).paths().iter().any(|path| ndl::is_same_host(*path, local))
    }

    fn accepted(&mut self, socket: TcpStream, ctx: &mut Context<Self>) {
        // It has gone again already where the system does not know.
        let Ok(from) = socket.peer_addr() else { return };
        let (connection, transport) = (self.core.open(), Transport::open(socket));
        let mode = Arc::new(Mutex::new(Mode::Handshake));
        let reading = self.reading(&mode);
        let shared = (mode, reading.heard.clone());
        let reader = self.crowd.join(link::read(connection, transport.clone(), reading));
        self.wires.insert(connection, Wire::new(Some(transport), shared, reader, self.secure.is_none()));
        self.input(Input::Accepted(connection, from.ip()), ctx);
    }
}

impl StreamHandler<io::Result<TcpStream>> for Gncl {
    fn handle(&mut self, accepted: io::Result<TcpStream>, ctx: &mut Context<Self>) {
        match accepted {
            Ok(socket) if !self.listens_at(&socket) => {
                let detail = format_args!("a connection to {:?}", socket.local_addr());
                self.stores.gncl.refusals.count(Time::now(), "connection over another interface", &detail);
            }
            Ok(socket) => self.accepted(socket, ctx),
            Err(error) => {
                self.stores.gncl.refusals.count(Time::now(), "not accepted", &error);
                if listener::is_starved(&error) {
                    self.input(Input::Starved, ctx);
                }
            }
        }
    }
}
