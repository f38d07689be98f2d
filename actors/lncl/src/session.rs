//! The meaning of a client's frames, and the check whether it may send them. Pure: frames in, orders out.

use std::{collections::BTreeSet, time::Duration};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::{AppAddress, Tid},
    wire::{Class, Flags, Kind, Message},
};

use sinew_protocol::{
    observed::Observed,
    payload::{self, Group, Introduce, Register, Resolve, Switch, TypeDeclaration},
};

/// Maximum number of groups of one client.
pub const GROUPS_MAX: usize = 256;

/// State of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// It is not registered yet.
    Unregistered,
    /// It has an address and waits at the start-up barrier.
    Waiting(Tid),
    /// It sends and receives.
    Open(Tid),
}

/// The protocol state of one connection.
#[derive(Debug)]
pub struct Session {
    phase: Phase,
    groups: BTreeSet<AppAddress>,
}

/// The action that a frame requires of the shell.
#[derive(Debug)]
pub enum Order {
    /// Register this application.
    Register(Register),
    /// Route this message.
    Route(Message),
    /// Settle the message that this client has in hand.
    Settle { source: Tid, correlation: u64, outcome: Outcome },
    /// Change a membership. If `confirm` is the client's correlation, notify the client of it.
    SetMember { group: AppAddress, member: bool, confirm: Option<u64> },
    /// Count a membership that stays unchanged for this reason. Send the client the outcome of its message
    /// `correlation` to `destination`.
    RefuseMembership { destination: Tid, correlation: u64, outcome: Outcome, why: MembershipError },
    /// Send the client the TID of `name`.
    Resolve { name: String, nearest: bool, correlation: u64 },
    /// Request a link from the client to `to`, or send the client the rejection.
    Introduce { to: Tid, correlation: u64 },
    /// Notify `to`, behind all earlier messages of the client to it, that the client continues on their link `number`.
    Switch { to: Tid, number: u64, correlation: u64 },
    /// Record the structure of a type of the client.
    DeclareType(TypeDeclaration),
    /// Record that the program of a command is ready.
    Ready,
    /// Report a message on a direct link of the client to the tap.
    Observe(Box<Observed>),
    /// Count a rejected message, and send the outcome if the client requested it. The connection continues.
    RefuseMessage { message: Message, why: Rejection },
    /// The client ends normally.
    Unregister,
    /// Refuse the connection with a reason, and end it.
    End(ProtocolError),
}

/// A frame that ends its connection. The client is at fault.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub enum ProtocolError {
    /// The first frame does not request an address.
    #[error("the first frame must ask for an address (kind {asked}), not be of kind {0}", asked = Kind::LNCL_REGISTER)]
    NotRegistered(Kind),
    /// A second registration on one connection.
    #[error("this connection has an address; open another connection for another address")]
    RegisteredTwice,
    /// A frame before the barrier opened.
    #[error("a frame of kind {0} came before LNCL_REGISTERED: the barrier is not open yet")]
    TooEarly(Kind),
    /// A kind that clients may not send.
    #[error("an application may not send frames of kind {0}")]
    NotForClients(Kind),
    /// A payload that does not match its kind.
    #[error("a frame of kind {kind} cannot be read: {cause}")]
    Malformed {
        /// The kind.
        kind: Kind,
        /// The decoder's error.
        cause: String,
    },
}

/// Reason why a client's frames do not change a membership. The client is at fault; nothing changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MembershipError {
    /// It is in the maximum number of groups.
    #[error(
        "it is in {GROUPS_MAX} groups, which is the most for one application; leave one before group {0}"
    )]
    Full(AppAddress),
    /// The address is not that of a group.
    #[error(
        "{0} is not the address of a group, which are f0000000 to fffffffe, hexadecimal; make it of a name"
    )]
    NoGroup(AppAddress),
}

impl MembershipError {
    /// Returns the outcome for the client, which is one byte.
    const fn outcome(self) -> Outcome {
        Outcome::Rejected(match self {
            Self::Full(_) => Rejection::QueueFull,
            Self::NoGroup(_) => Rejection::Unsupported,
        })
    }
}

impl Default for Session {
    /// Creates the state of a new connection.
    fn default() -> Self {
        Self { phase: Phase::Unregistered, groups: BTreeSet::new() }
    }
}

impl Session {
    /// Records the address that the client was given.
    pub const fn registered(&mut self, tid: Tid) {
        self.phase = Phase::Waiting(tid);
    }

    /// Opens the session: the barrier has opened for the client.
    pub const fn released(&mut self, tid: Tid) {
        self.phase = Phase::Open(tid);
    }

    /// Removes a group that the client did not join, for a reason outside its frames.
    pub fn remove_group(&mut self, group: AppAddress) {
        self.groups.remove(&group);
    }

    /// Returns the action for a frame.
    pub fn handle(&mut self, message: Message) -> Order {
        let order = match self.phase {
            Phase::Unregistered => read_first(&message),
            Phase::Waiting(_) => read_early(&message),
            Phase::Open(tid) => return self.read_open(tid, message),
        };
        order.unwrap_or_else(Order::End)
    }

    fn read_open(&mut self, tid: Tid, message: Message) -> Order {
        // spec: LNCL-3: a forged source costs the message, not the connection.
        if message.header.source != tid {
            return Order::RefuseMessage { message, why: Rejection::ForgedSource };
        }
        let kind = message.header.kind;
        if kind.is_user() {
            return read_data(message);
        }
        let order = match kind {
            Kind::OUTCOME => read_outcome(&message),
            Kind::LNCL_GROUP => self.read_group(&message),
            Kind::LNCL_RESOLVE => read_resolve(&message),
            Kind::LNCL_INTRODUCE => read_introduce(&message),
            Kind::LNCL_SWITCH => read_switch(&message),
            Kind::LNCL_OBSERVED => read_observed(&message),
            Kind::LNCL_TYPE => read_payload(&message).map(Order::DeclareType),
            Kind::LNCL_READY => Ok(Order::Ready),
            Kind::LNCL_UNREGISTER => Ok(Order::Unregister),
            Kind::LNCL_REGISTER => Err(ProtocolError::RegisteredTwice),
            // Not a Rust enum, but an open set of numbers.
            _ => Err(ProtocolError::NotForClients(kind)),
        };
        order.unwrap_or_else(Order::End)
    }

    fn read_group(&mut self, message: &Message) -> Result<Order, ProtocolError> {
        let Group { group, member } = read_payload(message)?;
        let confirm = message.header.flags.has(Flags::CONFIRM).then_some(message.header.correlation);
        let refuse = |why: MembershipError| Order::RefuseMembership {
            destination: message.header.destination,
            correlation: message.header.correlation,
            outcome: why.outcome(),
            why,
        };
        if !group.is_group() {
            return Ok(refuse(MembershipError::NoGroup(group)));
        }
        if !member {
            self.groups.remove(&group);
        } else if self.groups.len() >= GROUPS_MAX && !self.groups.contains(&group) {
            return Ok(refuse(MembershipError::Full(group)));
        } else {
            self.groups.insert(group);
        }
        Ok(Order::SetMember { group, member, confirm })
    }
}

fn read_first(message: &Message) -> Result<Order, ProtocolError> {
    if message.header.kind != Kind::LNCL_REGISTER {
        return Err(ProtocolError::NotRegistered(message.header.kind));
    }
    read_payload(message).map(Order::Register)
}

fn read_early(message: &Message) -> Result<Order, ProtocolError> {
    match message.header.kind {
        Kind::LNCL_UNREGISTER => Ok(Order::Unregister),
        Kind::LNCL_REGISTER => Err(ProtocolError::RegisteredTwice),
        // Not a Rust enum, but an open set of numbers.
        kind => Err(ProtocolError::TooEarly(kind)),
    }
}

fn read_data(mut message: Message) -> Order {
    // The flag belongs only to frames of kind OUTCOME; later code could take a message with it for one. A Stream keeps
    // only its newest message, so an older one has no outcome of its own.
    let is_confirmed_stream =
        message.header.class == Class::Stream && message.header.flags.has(Flags::CONFIRM);
    if message.header.flags.has(Flags::OUTCOME) || is_confirmed_stream {
        return Order::RefuseMessage { message, why: Rejection::Unsupported };
    }
    // It was sent on this host, so the clocks do not differ.
    message.header.set_sent_error(Some(Duration::ZERO));
    Order::Route(message)
}

fn read_outcome(message: &Message) -> Result<Order, ProtocolError> {
    let [code] = message.payload[..] else {
        return Err(malformed(message, &format!("{} bytes instead of one", message.payload.len())));
    };
    let outcome = Outcome::from_code(code)
        .ok_or_else(|| malformed(message, &format!("no outcome has the code {code}")))?;
    Ok(Order::Settle { source: message.header.destination, correlation: message.header.correlation, outcome })
}

fn read_resolve(message: &Message) -> Result<Order, ProtocolError> {
    let Resolve { name, nearest } = read_payload(message)?;
    Ok(Order::Resolve { name, nearest, correlation: message.header.correlation })
}

fn read_introduce(message: &Message) -> Result<Order, ProtocolError> {
    let Introduce { to } = read_payload(message)?;
    Ok(Order::Introduce { to: Tid::from_bits(to), correlation: message.header.correlation })
}

fn read_switch(message: &Message) -> Result<Order, ProtocolError> {
    let Switch { peer, number } = read_payload(message)?;
    Ok(Order::Switch { to: Tid::from_bits(peer), number, correlation: message.header.correlation })
}

fn read_observed(message: &Message) -> Result<Order, ProtocolError> {
    let observed = Observed::read(&message.payload).map_err(|cause| malformed(message, &cause))?;
    Ok(Order::Observe(Box::new(observed)))
}

fn read_payload<P: serde::de::DeserializeOwned>(message: &Message) -> Result<P, ProtocolError> {
    payload::read(&message.payload).map_err(|cause| malformed(message, &cause))
}

fn malformed(message: &Message, cause: &dyn std::fmt::Display) -> ProtocolError {
    ProtocolError::Malformed { kind: message.header.kind, cause: cause.to_string() }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use proptest::prelude::*;
    use sinew_runtime::{tid::NodeAddress, wire::Header};

    use super::*;

    const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);
    const TID: Tid = Tid::new(NODE, AppAddress::new(0x1000));
    const OTHER: Tid = Tid::new(NODE, AppAddress::new(0x2000));

    fn open() -> Session {
        let mut session = Session::default();
        session.registered(TID);
        session.released(TID);
        session
    }

    fn message(kind: Kind, source: Tid, payload: &[u8]) -> Message {
        Message::new(Header::new(kind, source, OTHER), Bytes::copy_from_slice(payload))
    }

    fn group(group: AppAddress, member: bool) -> Message {
        payload::frame(Kind::LNCL_GROUP, TID, OTHER, &Group { group, member })
    }

    #[test]
    fn unregistered_client_may_only_register() {
        let order = Session::default().handle(message(Kind::named("x"), Tid::NONE, b""));
        assert!(matches!(order, Order::End(ProtocolError::NotRegistered(_))));
        let asked = payload::frame(Kind::LNCL_REGISTER, Tid::NONE, OTHER, &Register::default());
        assert!(matches!(Session::default().handle(asked), Order::Register(_)));
    }

    #[test]
    fn nothing_is_routed_before_the_barrier_opens() {
        let mut session = Session::default();
        session.registered(TID);
        let order = session.handle(message(Kind::named("x"), TID, b""));
        assert!(matches!(order, Order::End(ProtocolError::TooEarly(_))));
        assert!(matches!(session.handle(message(Kind::LNCL_UNREGISTER, TID, b"")), Order::Unregister));
    }

    #[test]
    fn forged_source_costs_the_message_not_the_connection() {
        let mut session = open();
        let order = session.handle(message(Kind::named("x"), OTHER, b""));
        assert!(matches!(order, Order::RefuseMessage { why: Rejection::ForgedSource, .. }));
        assert!(matches!(session.handle(message(Kind::named("x"), TID, b"")), Order::Route(_)));
    }

    #[test]
    fn layer_kind_from_an_application_ends_its_connection() {
        for kind in [Kind::SYNC_DIRECTORY, Kind::GNCL_HELLO, Kind::LNCL_REGISTERED, Kind::from_bits(0x7fff)] {
            let order = open().handle(message(kind, TID, b""));
            assert!(matches!(order, Order::End(ProtocolError::NotForClients(_))), "{kind}");
        }
    }

    #[test]
    fn outcome_is_one_valid_byte() {
        let read = |payload: &[u8]| open().handle(message(Kind::OUTCOME, TID, payload));
        assert!(matches!(read(&[0]), Order::Settle { source: OTHER, outcome: Outcome::Delivered, .. }));
        for wrong in [&[][..], &[99], &[0, 0]] {
            assert!(matches!(read(wrong), Order::End(ProtocolError::Malformed { .. })));
        }
    }

    #[test]
    fn memberships_of_a_client_are_bounded() {
        let mut session = open();
        for n in 0..GROUPS_MAX {
            let order = session.handle(group(AppAddress::group(&n.to_string()), true));
            assert!(matches!(order, Order::SetMember { .. }));
        }
        let one_more = session.handle(group(AppAddress::group("one more"), true));
        let Order::RefuseMembership { outcome, why, .. } = one_more else { panic!("{one_more:?}") };
        let refused = Outcome::Rejected(Rejection::QueueFull);
        assert_eq!((outcome, why), (refused, MembershipError::Full(AppAddress::group("one more"))));
        assert!(why.to_string().contains("256 groups"), "{why}");
        session.handle(group(AppAddress::group("0"), false));
        let order = session.handle(group(AppAddress::group("one more"), true));
        assert!(matches!(order, Order::SetMember { .. }));
        // A join that was refused for another reason takes no slot.
        session.remove_group(AppAddress::group("one more"));
        let order = session.handle(group(AppAddress::group("another one"), true));
        assert!(matches!(order, Order::SetMember { .. }));
    }

    #[test]
    fn address_that_is_no_group_cannot_be_joined() {
        let order = open().handle(group(AppAddress::LNCL, true));
        let Order::RefuseMembership { outcome, why, .. } = order else { panic!("{order:?}") };
        let refused = Outcome::Rejected(Rejection::Unsupported);
        assert_eq!((outcome, why), (refused, MembershipError::NoGroup(AppAddress::LNCL)));
    }

    proptest! {
        #[test]
        fn any_payload_of_any_kind_is_an_order(kind in 0u32..0x70, payload: Vec<u8>, step in 0..3) {
            let mut session = Session::default();
            if step > 0 { session.registered(TID); }
            if step > 1 { session.released(TID); }
            session.handle(message(Kind::from_bits(kind), TID, &payload));
        }
    }
}
