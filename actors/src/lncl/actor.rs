//! LNCL's shell: opens the door for other processes, and lets applications through the barrier.

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
use crate::{stores::Stores, undelivered};

/// Time between two looks at messages that wait for clients that do not read, and at refusals that are to be reported.
const TICK: Duration = Duration::from_millis(100);

/// The LNCL of a node: a new one after each fault, on the same registry. Connections end with it.
pub(crate) struct Lncl {
    server: Rc<Server>,
    ready: Option<ReadyGate>,
}

impl Lncl {
    /// An LNCL on the registry in `stores`; it opens `ready` when other processes can connect.
    pub(crate) fn new(stores: Arc<Stores>, ready: ReadyGate) -> Self {
        Self { server: Server::new(stores), ready: Some(ready) }
    }

    /// Opens the door, if there is to be one.
    ///
    /// # Panics
    /// If the path was lost, and cannot be had again. That is how a layer's start fails: its supervisor reports these words.
    fn open_door(&mut self, ctx: &mut Context<Self>) {
        let Some(path) = self.server.stores.config.lncl.socket.clone() else { return };
        descriptors::make_room(&self.server.stores.config.lncl);
        let in_words = |cause| ListenError::System { doing: "watch", path: path.clone(), cause };
        let opened = self.server.stores.open_door(&path);
        let opened = opened.and_then(|listener| UnixListener::from_std(listener).map_err(in_words));
        let listener = opened.unwrap_or_else(|error| panic!("LNCL cannot start: {error}"));
        ctx.spawn(accept(self.server.clone(), listener).into_actor(self));
        crate::log::debug!(?path, "applications of other processes can connect");
    }
}

impl Actor for Lncl {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        registrar::forget_former_clients(&self.server.stores);
        self.server.stores.door.hang_up();
        ctx.add_stream(self.server.stores.posts.lncl.attach());
        ctx.run_interval(TICK, |lncl, _| lncl.server.tick(Time::now()));
        self.open_door(ctx);
        if let Some(ready) = self.ready.take() {
            ready.reached();
        }
    }

    fn stopping(&mut self, _: &mut Self::Context) -> Running {
        // Only when the node stops: those who come while this layer is restarted wait for its next life.
        if self.server.stores.stopping.load(Ordering::Relaxed) {
            self.server.stores.door.close();
        }
        Running::Stop
    }
}

impl StreamHandler<Event> for Lncl {
    fn handle(&mut self, event: Event, _: &mut Self::Context) {
        match event {
            Event::Released { app } => self.server.release(app),
            Event::Undelivered => undelivered::report(&self.server.stores, Time::now()),
        }
    }
}
