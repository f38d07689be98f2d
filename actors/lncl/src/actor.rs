//! LNCL's shell: opens the client socket, and releases applications from the barrier.

use std::{
    rc::Rc,
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use actix::{Actor, AsyncContext, Context, Running, StreamHandler, fut::WrapFuture};
use sinew_runtime::{supervision::ReadyGate, time::Time};
use tokio::net::UnixListener;

use super::{
    Event, descriptors,
    listener::ListenError,
    registrar,
    server::{Server, accept},
};
use crate::{State, undelivered};

/// Interval of the checks for expired messages of clients that do not read, and for due reports of rejections. Without
/// such items there are no checks: a node at rest is not woken.
const TICK: Duration = Duration::from_millis(100);

/// The LNCL of a node. A new one starts after each fault, on the same registry. Connections end with it.
pub struct Lncl {
    server: Rc<Server>,
    ready: Option<ReadyGate>,
}

impl Lncl {
    /// Creates an LNCL on the registry in `state`. It opens `ready` when other processes can connect.
    pub fn new(state: Arc<State>, ready: ReadyGate) -> Self {
        Self { server: Server::new(state), ready: Some(ready) }
    }

    /// Opens the client socket, if one is configured.
    ///
    /// # Panics
    /// If the path was lost and cannot be reclaimed. A layer's start fails by a panic, and its supervisor reports this
    /// message.
    fn open_client_socket(&mut self, ctx: &mut Context<Self>) {
        let Some(path) = self.server.state.ctx.config.lncl.socket.clone() else { return };
        descriptors::make_room(&self.server.state.ctx.config.lncl);
        let to_error = |cause| ListenError::System { doing: "watch", path: path.clone(), cause };
        let opened = self.server.state.open_client_socket(&path);
        let opened = opened.and_then(|listener| UnixListener::from_std(listener).map_err(to_error));
        let listener = opened.unwrap_or_else(|error| panic!("LNCL cannot start: {error}"));
        ctx.spawn(accept(self.server.clone(), listener).into_actor(self));
        sinew_runtime::log::debug!(?path, "applications of other processes can connect");
    }
}

impl Actor for Lncl {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        registrar::remove_former_clients(&self.server.state);
        self.server.state.client_socket.hang_up();
        ctx.add_stream(self.server.state.ctx.event_queues.lncl.attach());
        let server = self.server.clone();
        let checks = async move { server.state.ctx.checks.run(TICK, || server.tick(Time::now())).await };
        ctx.spawn(checks.into_actor(self));
        self.open_client_socket(ctx);
        if let Some(ready) = self.ready.take() {
            ready.reached();
        }
    }

    fn stopping(&mut self, _: &mut Self::Context) -> Running {
        // Only when the node stops: new connections wait during a restart of this layer.
        if self.server.state.ctx.stopping.load(Ordering::Relaxed) {
            self.server.state.client_socket.close();
        }
        Running::Stop
    }
}

impl StreamHandler<Event> for Lncl {
    fn handle(&mut self, event: Event, _: &mut Self::Context) {
        match event {
            Event::Released { app } => self.server.release(app),
            Event::Undelivered => {
                if undelivered::report(&self.server.state, Time::now()) {
                    self.server.state.ctx.checks.request();
                }
            }
        }
    }
}
