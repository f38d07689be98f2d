//! An endpoint in each of its forms behind one face, so that one suite holds both to the same claims.

use std::{future::Future, path::Path, time::Duration};

use sinew_runtime::{
    outcome::Outcome,
    tid::Tid,
    wire::{Kind, Payload},
};
use tokio::runtime::{Builder, Runtime};

use crate::{
    api::{
        ApiError, AsyncEndpoint, Endpoint, LentMessage, NodeApi, Received, Registration, Transport, Untaken,
    },
    lncl::testing::TestNode,
};

/// What a claim is made about.
#[derive(Clone, Copy, Debug)]
pub(super) struct Under {
    pub(super) transport: Transport,
    pub(super) form: Form,
    /// Whether what goes to other endpoints may go there directly.
    pub(super) direct: bool,
}

/// Who waits.
#[derive(Clone, Copy, Debug)]
pub(super) enum Form {
    Thread,
    Task,
}

/// The way to a node, in one form.
#[derive(Clone, Debug)]
pub(super) struct Api {
    form: Form,
    node: NodeApi,
}

impl Api {
    pub(super) fn connect(under: Under, node: &TestNode) -> Self {
        Self::at(under, &node.path())
    }

    /// Not looked for: one that serves a single connection may listen there.
    pub(super) fn at(under: Under, path: &Path) -> Self {
        Self { form: under.form, node: NodeApi { path: path.to_owned() } }
    }

    pub(super) fn register(&self, registration: Registration) -> Result<Client, ApiError> {
        match self.form {
            Form::Thread => self.node.register_transport_address(registration).map(Client::Thread),
            Form::Task => {
                let runtime = Builder::new_current_thread().enable_all().build().unwrap();
                let endpoint = runtime.block_on(self.node.register_transport_address_async(registration))?;
                Ok(Client::Task(endpoint, runtime))
            }
        }
    }
}

/// An endpoint; one that is a task's has a runtime of its own, which runs while it is called.
#[derive(Debug)]
pub(super) enum Client {
    Thread(Endpoint),
    Task(AsyncEndpoint, Runtime),
}

/// The same call, blocking or awaited.
macro_rules! either {
    ($client:expr, $endpoint:ident => $call:expr) => {
        match $client {
            Client::Thread($endpoint) => $call,
            Client::Task($endpoint, runtime) => runtime.block_on(async { $call.await }),
        }
    };
}

/// The same look, which waits for nothing in either form.
macro_rules! look {
    ($client:expr, $endpoint:ident => $call:expr) => {
        match $client {
            Client::Thread($endpoint) => $call,
            Client::Task($endpoint, _) => $call,
        }
    };
}

impl Client {
    pub(super) fn tid(&self) -> Tid {
        look!(self, endpoint => endpoint.tid())
    }

    pub(super) fn registrations(&self) -> u64 {
        look!(self, endpoint => endpoint.registrations())
    }

    pub(super) fn transport(&self) -> Transport {
        look!(self, endpoint => endpoint.transport())
    }

    pub(super) fn node_name(&self) -> &str {
        look!(self, endpoint => endpoint.node_name())
    }

    pub(super) fn payload_max(&self) -> usize {
        look!(self, endpoint => endpoint.payload_max())
    }

    pub(super) fn create_message(
        &mut self,
        destination: Tid,
        kind: Kind,
        length: usize,
    ) -> Result<LentMessage, ApiError> {
        look!(self, endpoint => endpoint.create_message(destination, kind, length))
    }

    pub(super) fn send_message(&mut self, message: LentMessage) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.send_message(message))
    }

    pub(super) fn send_message_within(
        &mut self,
        message: LentMessage,
        within: Duration,
    ) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.send_message_within(message, within))
    }

    pub(super) fn send_message_confirmed(
        &mut self,
        message: LentMessage,
        within: Duration,
    ) -> Result<Outcome, ApiError> {
        either!(self, endpoint => endpoint.send_message_confirmed(message, within))
    }

    pub(super) fn ask_message(
        &mut self,
        message: LentMessage,
        within: Duration,
    ) -> Result<Received, ApiError> {
        either!(self, endpoint => endpoint.ask_message(message, within))
    }

    pub(super) fn reply_message(&mut self, request: &Received, message: LentMessage) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.reply_message(request, message))
    }

    pub(super) fn send<P: Payload>(&mut self, destination: Tid, value: &P) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.send(destination, value))
    }

    pub(super) fn send_within<P: Payload>(
        &mut self,
        destination: Tid,
        value: &P,
        within: Duration,
    ) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.send_within(destination, value, within))
    }

    pub(super) fn send_confirmed<P: Payload>(
        &mut self,
        destination: Tid,
        value: &P,
        within: Duration,
    ) -> Result<Outcome, ApiError> {
        either!(self, endpoint => endpoint.send_confirmed(destination, value, within))
    }

    pub(super) fn ask<P: Payload, R: Payload>(
        &mut self,
        destination: Tid,
        request: &P,
        within: Duration,
    ) -> Result<R, ApiError> {
        either!(self, endpoint => endpoint.ask(destination, request, within))
    }

    pub(super) fn reply<R: Payload>(&mut self, request: &Received, value: &R) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.reply(request, value))
    }

    pub(super) fn reply_within<R: Payload>(
        &mut self,
        request: &Received,
        value: &R,
        within: Duration,
    ) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.reply_within(request, value, within))
    }

    pub(super) fn receive(&mut self, within: Duration) -> Result<Option<Received>, ApiError> {
        match self {
            Self::Thread(endpoint) => endpoint.receive(within),
            Self::Task(endpoint, runtime) => runtime.block_on(within_time(within, endpoint.receive())),
        }
    }

    pub(super) fn untaken(&mut self) -> Option<Untaken> {
        look!(self, endpoint => endpoint.untaken())
    }

    pub(super) fn join(&mut self, name: &str) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.join(name))
    }

    pub(super) fn leave(&mut self, name: &str) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.leave(name))
    }

    pub(super) fn resolve(&mut self, name: &str, within: Duration) -> Result<Option<Tid>, ApiError> {
        either!(self, endpoint => endpoint.resolve(name, within))
    }

    pub(super) fn unregister(self) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.unregister())
    }
}

async fn within_time<T>(
    within: Duration,
    future: impl Future<Output = Result<T, ApiError>>,
) -> Result<Option<T>, ApiError> {
    tokio::time::timeout(within, future).await.map_or(Ok(None), |done| done.map(Some))
}
