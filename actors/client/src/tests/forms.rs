//! An endpoint in each of its forms behind one interface, so that one suite tests both for the same claims.

mod in_c;

use std::{
    future::Future,
    ops::{Deref, DerefMut},
    path::Path,
    time::Duration,
};

use sinew_c::conformance::{InHand, Made};
use sinew_lncl::testing::TestNode;
use sinew_runtime::{
    outcome::{MemberOutcome, Outcome},
    tid::Tid,
    time::Time,
    undelivered::Undelivered,
    wire::{DecodeError, Kind, Payload},
};
use tokio::runtime::{Builder, Runtime};

use crate::{
    ApiError, AsyncEndpoint, Endpoint, EventLoop, LoanedMessage, NodeApi, Received, Registration, Transport,
    event_loop::tests::{run, run_within},
    link::ServerTrust,
};

/// The subject of a claim.
#[derive(Clone, Copy, Debug)]
pub(super) struct Under {
    pub(super) transport: Transport,
    pub(super) form: Form,
    /// Whether messages to other endpoints may take a direct link.
    pub(super) direct: bool,
}

/// The form of the wait.
#[derive(Clone, Copy, Debug)]
pub(super) enum Form {
    Thread,
    Task,
    /// A task of an event loop that is not tokio's.
    Polled,
    /// A thread that calls the functions of `sinew.h`.
    C,
}

/// The access to a node, in one form.
#[derive(Clone, Debug)]
pub(super) struct Api {
    form: Form,
    node: NodeApi,
}

impl Api {
    pub(super) fn connect(under: Under, node: &TestNode) -> Self {
        Self::at(under, &node.path())
    }

    /// Does not check for a listener: a node that serves a single connection may listen there.
    pub(super) fn at(under: Under, path: &Path) -> Self {
        let node = NodeApi { path: path.to_owned(), server_trust: ServerTrust::AnyUser };
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
            Form::Polled => {
                let events = EventLoop::new().unwrap();
                let registering = self.node.register_transport_address_on(registration, events.clone());
                let endpoint = run(&events, registering)?;
                Ok(Client::Polled(endpoint, events))
            }
            Form::C => in_c::Client::register(&self.node.path, &registration).map(Client::C),
        }
    }
}

/// An endpoint; one for tasks has a runtime of its own, which runs during a call.
#[derive(Debug)]
pub(super) enum Client {
    Thread(Endpoint),
    Task(AsyncEndpoint, Runtime),
    Polled(AsyncEndpoint, EventLoop),
    C(in_c::Client),
}

/// Loaned memory for a message.
#[derive(Debug)]
pub(super) enum Loaned {
    Rust(LoanedMessage),
    C(Made),
}

/// A message in hand.
#[derive(Debug)]
pub(super) enum AnyReceived {
    Rust(Received),
    C(InHand),
}

/// The same call: blocking or awaited, and in C.
macro_rules! either {
    ($client:expr, $endpoint:ident => $call:expr, $in_c:expr) => {
        match $client {
            Client::Thread($endpoint) => $call,
            Client::Task($endpoint, runtime) => runtime.block_on(async { $call.await }),
            Client::Polled($endpoint, events) => run(&events, async { $call.await }),
            Client::C($endpoint) => $in_c,
        }
    };
}

/// The same check in every form; it never waits.
macro_rules! check {
    ($client:expr, $endpoint:ident => $call:expr, $in_c:expr) => {
        match $client {
            Client::Thread($endpoint) => $call,
            Client::Task($endpoint, _) | Client::Polled($endpoint, _) => $call,
            Client::C($endpoint) => $in_c,
        }
    };
}

/// A message of one form used with another: the suite has one form at a time.
const OF_ANOTHER_FORM: &str = "all of one test is of one form";

impl Loaned {
    fn of_rust(self) -> LoanedMessage {
        let Self::Rust(message) = self else { panic!("{OF_ANOTHER_FORM}") };
        message
    }

    fn of_c(self) -> Made {
        let Self::C(message) = self else { panic!("{OF_ANOTHER_FORM}") };
        message
    }
}

impl Deref for Loaned {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match self {
            Self::Rust(message) => message,
            Self::C(message) => message,
        }
    }
}

impl DerefMut for Loaned {
    fn deref_mut(&mut self) -> &mut [u8] {
        match self {
            Self::Rust(message) => message,
            Self::C(message) => message,
        }
    }
}

impl AnyReceived {
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

    /// C returns the send time, and leaves the subtraction to the program.
    pub(super) fn age(&self, now: Time) -> Option<Duration> {
        match self {
            Self::Rust(message) => message.age(now),
            Self::C(message) => in_c::message_of(message).header.age(now),
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

/// A message to be sent, by the builder of the form.
#[derive(Debug)]
pub(super) struct Sending<'a, C> {
    client: &'a mut Client,
    to: Tid,
    content: C,
    room: Option<Duration>,
}

/// The builder with the limit on the wait for room, if there is one.
macro_rules! limited {
    ($builder:expr, $room:expr) => {
        match $room {
            Some(room) => $builder.room_within(room),
            None => $builder,
        }
    };
}

impl<C> Sending<'_, C> {
    pub(super) fn room_within(mut self, room: Duration) -> Self {
        self.room = Some(room);
        self
    }
}

impl Sending<'_, Loaned> {
    pub(super) fn send(self) -> Result<(), ApiError> {
        let (message, room) = (self.content, self.room);
        either!(self.client, endpoint => limited!(endpoint.loaned(message.of_rust()), room).send(), endpoint.send_message(message.of_c(), room))
    }

    pub(super) fn confirmed(self, within: Duration) -> Result<Outcome, ApiError> {
        let message = self.content;
        either!(self.client, endpoint => endpoint.loaned(message.of_rust()).confirmed(within), endpoint.confirm_message(message.of_c(), within))
    }

    pub(super) fn ask_raw(self, within: Duration) -> Result<AnyReceived, ApiError> {
        let message = self.content;
        match self.client {
            Client::Thread(endpoint) => {
                endpoint.loaned(message.of_rust()).ask_raw(within).map(AnyReceived::Rust)
            }
            Client::Task(endpoint, runtime) => {
                runtime.block_on(endpoint.loaned(message.of_rust()).ask_raw(within)).map(AnyReceived::Rust)
            }
            Client::Polled(endpoint, events) => {
                run(events, endpoint.loaned(message.of_rust()).ask_raw(within)).map(AnyReceived::Rust)
            }
            Client::C(endpoint) => endpoint.ask_message(message.of_c(), within).map(AnyReceived::C),
        }
    }

    pub(super) fn reply_to(self, request: &AnyReceived) -> Result<(), ApiError> {
        let message = self.content;
        either!(self.client, endpoint => endpoint.loaned(message.of_rust()).reply_to(request.of_rust()), endpoint.reply_message(request.of_c(), message.of_c(), None))
    }
}

impl<P: Payload> Sending<'_, &P> {
    pub(super) fn send(self) -> Result<(), ApiError> {
        let (to, value, room) = (self.to, self.content, self.room);
        either!(self.client, endpoint => limited!(endpoint.message(to, value), room).send(), endpoint.send(to, value, room))
    }

    pub(super) fn confirmed(self, within: Duration) -> Result<Outcome, ApiError> {
        let (to, value) = (self.to, self.content);
        either!(self.client, endpoint => endpoint.message(to, value).confirmed(within), endpoint.confirm(to, value, within))
    }

    pub(super) fn confirmed_by_each(self, within: Duration) -> Result<Vec<MemberOutcome>, ApiError> {
        let (to, value) = (self.to, self.content);
        either!(self.client, endpoint => endpoint.message(to, value).confirmed_by_each(within), endpoint.confirm_by_each(to, value, within))
    }

    pub(super) fn ask<R: Payload>(self, within: Duration) -> Result<R, ApiError> {
        let (to, request) = (self.to, self.content);
        either!(self.client, endpoint => endpoint.message(to, request).ask(within), endpoint.ask(to, request, within))
    }

    pub(super) fn reply_to(self, request: &AnyReceived) -> Result<(), ApiError> {
        let (value, room) = (self.content, self.room);
        either!(self.client, endpoint => limited!(endpoint.message(Tid::NONE, value), room).reply_to(request.of_rust()), endpoint.reply(request.of_c(), value, room))
    }
}

impl Client {
    pub(super) fn tid(&self) -> Tid {
        check!(self, endpoint => endpoint.tid(), endpoint.tid())
    }

    pub(super) fn registrations(&mut self) -> u64 {
        check!(self, endpoint => endpoint.registrations(), endpoint.registrations())
    }

    /// `None`: the form does not report it.
    pub(super) fn transport(&self) -> Option<Transport> {
        match self {
            Self::Thread(endpoint) => Some(endpoint.transport()),
            Self::Task(endpoint, _) | Self::Polled(endpoint, _) => Some(endpoint.transport()),
            Self::C(_) => None,
        }
    }

    pub(super) fn node_name(&self) -> &str {
        check!(self, endpoint => endpoint.node_name(), endpoint.node_name())
    }

    pub(super) fn payload_max(&self) -> usize {
        check!(self, endpoint => endpoint.payload_max(), endpoint.payload_max())
    }

    pub(super) fn create_message(
        &mut self,
        destination: Tid,
        kind: Kind,
        length: usize,
    ) -> Result<Loaned, ApiError> {
        check!(
            self,
            endpoint => endpoint.create_message(destination, kind, length).map(Loaned::Rust),
            endpoint.create(destination, kind, length).map(Loaned::C)
        )
    }

    pub(super) fn loaned(&mut self, message: Loaned) -> Sending<'_, Loaned> {
        Sending { client: self, to: Tid::NONE, content: message, room: None }
    }

    pub(super) fn message<'a, P: Payload>(&'a mut self, to: Tid, value: &'a P) -> Sending<'a, &'a P> {
        Sending { client: self, to, content: value, room: None }
    }

    pub(super) fn send<P: Payload>(&mut self, to: Tid, value: &P) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.send(to, value), endpoint.send(to, value, None))
    }

    pub(super) fn reply<R: Payload>(&mut self, request: &AnyReceived, value: &R) -> Result<(), ApiError> {
        either!(self, endpoint => endpoint.reply(request.of_rust(), value), endpoint.reply(request.of_c(), value, None))
    }

    pub(super) fn receive(&mut self, within: Duration) -> Result<Option<AnyReceived>, ApiError> {
        let received = match self {
            Self::Thread(endpoint) => endpoint.receive(within),
            Self::Task(endpoint, runtime) => runtime.block_on(within_time(within, endpoint.receive())),
            Self::Polled(endpoint, events) => run_within(events, within, endpoint.receive()).transpose(),
            Self::C(endpoint) => return Ok(endpoint.receive(within)?.map(AnyReceived::C)),
        };
        Ok(received?.map(AnyReceived::Rust))
    }

    pub(super) fn take_undelivered(&mut self) -> Option<Undelivered> {
        check!(self, endpoint => endpoint.take_undelivered(), endpoint.take_undelivered())
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
