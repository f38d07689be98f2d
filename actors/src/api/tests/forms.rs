//! An endpoint in each of its forms behind one face, so that one suite holds both to the same claims.

mod in_c;

use std::{
    future::Future,
    ops::{Deref, DerefMut},
    path::Path,
    time::Duration,
};

use sinew_c::conformance::{InHand, Made};
use sinew_runtime::{
    outcome::Outcome,
    tid::Tid,
    time::Time,
    wire::{DecodeError, Kind, Payload},
};
use tokio::runtime::{Builder, Runtime};

use crate::{
    api::{
        ApiError, AsyncEndpoint, Endpoint, LoanedMessage, NodeApi, Received, Registration, Transport,
        Undelivered, link::Believed,
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
    /// A thread that calls the functions of `sinew.h`.
    C,
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
        let node = NodeApi { path: path.to_owned(), believed: Believed::Anybody };
        Self { form: under.form, node }
    }

    pub(super) fn register(&self, registration: Registration) -> Result<Client, ApiError> {
        match self.form {
            Form::Thread => self.node.register_transport_address(registration).map(Client::Thread),
            Form::Task => {
                let runtime = Builder::new_current_thread().enable_all().build().unwrap();
                let endpoint = runtime.block_on(self.node.register_transport_address_async(registration))?;
                Ok(Client::Task(endpoint, runtime))
            }
            Form::C => in_c::Client::register(&self.node.path, &registration).map(Client::C),
        }
    }
}

/// An endpoint; one that is a task's has a runtime of its own, which runs while it is called.
#[derive(Debug)]
pub(super) enum Client {
    Thread(Endpoint),
    Task(AsyncEndpoint, Runtime),
    C(in_c::Client),
}

/// Memory for a message that was lent.
#[derive(Debug)]
pub(super) enum Lent {
    Rust(LoanedMessage),
    C(Made),
}

/// A message in hand.
#[derive(Debug)]
pub(super) enum Got {
    Rust(Received),
    C(InHand),
}

/// The same call: blocking or awaited, and in C.
macro_rules! either {
    ($client:expr, $endpoint:ident => $call:expr, $in_c:expr) => {
        match $client {
            Client::Thread($endpoint) => $call,
            Client::Task($endpoint, runtime) => runtime.block_on(async { $call.await }),
            Client::C($endpoint) => $in_c,
        }
    };
}

/// The same look, which waits for nothing in any form.
macro_rules! look {
    ($client:expr, $endpoint:ident => $call:expr, $in_c:expr) => {
        match $client {
            Client::Thread($endpoint) => $call,
            Client::Task($endpoint, _) => $call,
            Client::C($endpoint) => $in_c,
        }
    };
}

/// A message of one form in the hands of another: the suite has one form at a time.
const OF_ANOTHER_FORM: &str = "all of one test is of one form";

impl Lent {
    fn of_rust(self) -> LoanedMessage {
        let Self::Rust(message) = self else { panic!("{OF_ANOTHER_FORM}") };
        message
    }

    fn of_c(self) -> Made {
        let Self::C(message) = self else { panic!("{OF_ANOTHER_FORM}") };
        message
    }
}

impl Deref for Lent {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match self {
            Self::Rust(message) => message,
            Self::C(message) => message,
        }
    }
}

impl DerefMut for Lent {
    fn deref_mut(&mut self) -> &mut [u8] {
        match self {
            Self::Rust(message) => message,
            Self::C(message) => message,
        }
    }
}

impl Got {
    fn of_rust(&self) -> &Received {
        let Self::Rust(message) = self else { panic!("{OF_ANOTHER_FORM}") };
        message
    }

    fn of_c(&self) -> &InHand {
        let Self::C(message) = self else { panic!("{OF_ANOTHER_FORM}") };
        message
    }

    pub(super) fn source(&self) -> Tid {
        match self {
            Self::Rust(message) => message.source(),
            Self::C(message) => in_c::message_of(message).header.source,
        }
    }

    pub(super) fn destination(&self) -> Tid {
        match self {
            Self::Rust(message) => message.destination(),
            Self::C(message) => in_c::message_of(message).header.destination,
        }
    }

    pub(super) fn kind(&self) -> Kind {
        match self {
            Self::Rust(message) => message.kind(),
            Self::C(message) => in_c::message_of(message).header.kind,
        }
    }

    pub(super) fn wants_reply(&self) -> bool {
        match self {
            Self::Rust(message) => message.wants_reply(),
            Self::C(message) => message.fields().wants_reply,
        }
    }

    /// C says when it was sent, and leaves it to the program to subtract.
    pub(super) fn age(&self, now: Time) -> Duration {
        match self {
            Self::Rust(message) => message.age(now),
            Self::C(message) => now.since(in_c::message_of(message).header.sent),
        }
    }

    pub(super) fn bytes(&self) -> &[u8] {
        match self {
            Self::Rust(message) => message.bytes(),
            Self::C(message) => message.payload(),
        }
    }

    pub(super) fn decode<P: Payload>(&self) -> Result<P, DecodeError> {
        match self {
            Self::Rust(message) => message.decode(),
            Self::C(message) => in_c::message_of(message).decode(),
        }
    }

    pub(super) fn settle(self, outcome: Outcome) {
        match self {
            Self::Rust(message) => message.settle(outcome),
            Self::C(message) => in_c::settle(message, outcome),
        }
    }
}

impl Client {
    pub(super) fn tid(&self) -> Tid {
        look!(self, endpoint => endpoint.tid(), endpoint.tid())
    }

    pub(super) fn registrations(&mut self) -> u64 {
        look!(self, endpoint => endpoint.registrations(), endpoint.registrations())
    }

    /// `None`: the form does not tell.
    pub(super) fn transport(&self) -> Option<Transport> {
        match self {
            Self::Thread(endpoint) => Some(endpoint.transport()),
            Self::Task(endpoint, _) => Some(endpoint.transport()),
            Self::C(_) => None,
        }
    }

    pub(super) fn node_name(&self) -> &str {
        look!(self, endpoint => endpoint.node_name(), endpoint.node_name())
    }

    pub(super) fn payload_max(&self) -> usize {
        look!(self, endpoint => endpoint.payload_max(), endpoint.payload_max())
    }

    pub(super) fn create_message(
        &mut self,
        destination: Tid,
        kind: Kind,
        length: usize,
    ) -> Result<Lent, ApiError> {
        look!(
            self,
            endpoint => endpoint.create_message(destination, kind, length).map(Lent::Rust),
            endpoint.create(destination, kind, length).map(Lent::C)
        )
    }

    pub(super) fn send_message(&mut self, message: Lent) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.send_message(message.of_rust()), endpoint.send_message(message.of_c(), None))
    }

    pub(super) fn send_message_within(&mut self, message: Lent, within: Duration) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.send_message_within(message.of_rust(), within), endpoint.send_message(message.of_c(), Some(within)))
    }

    pub(super) fn send_message_confirmed(
        &mut self,
        message: Lent,
        within: Duration,
    ) -> Result<Outcome, ApiError> {
        either!(self, endpoint => endpoint.send_message_confirmed(message.of_rust(), within), endpoint.confirm_message(message.of_c(), within))
    }

    pub(super) fn ask_message(&mut self, message: Lent, within: Duration) -> Result<Got, ApiError> {
        match self {
            Self::Thread(endpoint) => endpoint.ask_message(message.of_rust(), within).map(Got::Rust),
            Self::Task(endpoint, runtime) => {
                runtime.block_on(endpoint.ask_message(message.of_rust(), within)).map(Got::Rust)
            }
            Self::C(endpoint) => endpoint.ask_message(message.of_c(), within).map(Got::C),
        }
    }

    pub(super) fn reply_message(&mut self, request: &Got, message: Lent) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.reply_message(request.of_rust(), message.of_rust()), endpoint.reply_message(request.of_c(), message.of_c(), None))
    }

    pub(super) fn send<P: Payload>(&mut self, destination: Tid, value: &P) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.send(destination, value), endpoint.send(destination, value, None))
    }

    pub(super) fn send_within<P: Payload>(
        &mut self,
        destination: Tid,
        value: &P,
        within: Duration,
    ) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.send_within(destination, value, within), endpoint.send(destination, value, Some(within)))
    }

    pub(super) fn send_confirmed<P: Payload>(
        &mut self,
        destination: Tid,
        value: &P,
        within: Duration,
    ) -> Result<Outcome, ApiError> {
        either!(self, endpoint => endpoint.send_confirmed(destination, value, within), endpoint.confirm(destination, value, within))
    }

    pub(super) fn ask<P: Payload, R: Payload>(
        &mut self,
        destination: Tid,
        request: &P,
        within: Duration,
    ) -> Result<R, ApiError> {
        either!(self, endpoint => endpoint.ask(destination, request, within), endpoint.ask(destination, request, within))
    }

    pub(super) fn reply<R: Payload>(&mut self, request: &Got, value: &R) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.reply(request.of_rust(), value), endpoint.reply(request.of_c(), value, None))
    }

    pub(super) fn reply_within<R: Payload>(
        &mut self,
        request: &Got,
        value: &R,
        within: Duration,
    ) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.reply_within(request.of_rust(), value, within), endpoint.reply(request.of_c(), value, Some(within)))
    }

    pub(super) fn receive(&mut self, within: Duration) -> Result<Option<Got>, ApiError> {
        let received = match self {
            Self::Thread(endpoint) => endpoint.receive(within),
            Self::Task(endpoint, runtime) => runtime.block_on(within_time(within, endpoint.receive())),
            Self::C(endpoint) => return Ok(endpoint.receive(within)?.map(Got::C)),
        };
        Ok(received?.map(Got::Rust))
    }

    pub(super) fn take_undelivered(&mut self) -> Option<Undelivered> {
        look!(self, endpoint => endpoint.take_undelivered(), endpoint.take_undelivered())
    }

    pub(super) fn join(&mut self, name: &str) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.join(name), endpoint.join(name))
    }

    pub(super) fn leave(&mut self, name: &str) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.leave(name), endpoint.leave(name))
    }

    pub(super) fn resolve(&mut self, name: &str, within: Duration) -> Result<Option<Tid>, ApiError> {
        either!(self, endpoint => endpoint.resolve(name, within), endpoint.resolve(name, within))
    }

    pub(super) fn unregister(self) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.unregister(), endpoint.unregister())
    }
}

async fn within_time<T>(
    within: Duration,
    future: impl Future<Output = Result<T, ApiError>>,
) -> Result<Option<T>, ApiError> {
    tokio::time::timeout(within, future).await.map_or(Ok(None), |done| done.map(Some))
}
