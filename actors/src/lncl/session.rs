//! What a client's frame means, and whether it may say so. Pure: frames in, orders out.

use std::{collections::BTreeSet, time::Duration};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::{AppAddress, Tid},
    wire::{Class, Flags, Kind, Message},
};

use super::payload::{self, Group, Introduce, Register, Resolve, Switch};

/// Groups that one client may be a member of.
pub(crate) const GROUPS_MAX: usize = 256;

/// How far a connection has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// Nobody knows who it is.
    Stranger,
    /// It has an address and waits at the start-up barrier.
    Waiting(Tid),
    /// It sends and receives.
    Open(Tid),
}

/// One connection, as far as its frames are concerned.
#[derive(Debug)]
pub(crate) struct Session {
    phase: Phase,
    groups: BTreeSet<AppAddress>,
}

/// What the shell has to do about a frame.
#[derive(Debug)]
pub(crate) enum Order {
    /// Register this application.
    Register(Register),
    /// Send this message on its way.
    Route(Message),
    /// Settle the message that this client has in hand.
    Settle { source: Tid, correlation: u64, outcome: Outcome },
    /// Change a membership, then tell the client so if `confirm` is its correlation.
    SetMember { group: AppAddress, member: bool, confirm: Option<u64> },
    /// Count that a membership stays as it is for this reason, and tell the client what became of its message `correlation`, to
    /// `destination`.
    Tell { destination: Tid, correlation: u64, outcome: Outcome, why: NoMembership },
    /// Tell the client the TID of `name`.
    Resolve { name: String, nearest: bool, correlation: u64 },
    /// Introduce the client to `to`, or tell it why not.
    Introduce { to: Tid, correlation: u64 },
    /// Tell `to`, behind all that the client has sent to it, that the client goes on on their link `number`.
    Switch { to: Tid, number: u64, correlation: u64 },
    /// Count this and, if the client asked, tell it so; the connection goes on.
    RefuseMessage { message: Message, why: Rejection },
    /// The client leaves in order.
    Unregister,
    /// Refuse the connection in words, and end it.
    End(Violation),
}

/// A frame that ends its connection. The client is at fault.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Violation {
    /// The first frame asks for no address.
    #[error("the first frame must ask for an address (kind {asked}), not be of kind {0}", asked = Kind::LNCL_REGISTER)]
    NotRegistered(Kind),
    /// A second registration on one connection.
    #[error("this connection has an address; open another connection for another address")]
    RegisteredTwice,
    /// A frame before the barrier opened.
    #[error("a frame of kind {0} came before LNCL_REGISTERED: the barrier is not open yet")]
    TooEarly(Kind),
    /// A kind that clients have no business with.
    #[error("an application may not send frames of kind {0}")]
    NotForClients(Kind),
    /// A payload that is not what its kind says.
    #[error("a frame of kind {kind} cannot be read: {cause}")]
    Malformed {
        /// The kind.
        kind: Kind,
        /// What is wrong with it.
        cause: String,
    },
}

/// Why a client does not become a member of a group, or leave it, as its frames show. The client is at fault; nothing changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum NoMembership {
    /// It is in as many groups as it may.
    #[error(
        "it is in {GROUPS_MAX} groups, which is the most for one application; leave one before group {0}"
    )]
    Full(AppAddress),
    /// What it names is none.
    #[error(
        "{0} is not the address of a group, which are f0000000 to fffffffe, hexadecimal; make it of a name"
    )]
    NoGroup(AppAddress),
}

impl NoMembership {
    /// What the client is told, which is a byte.
    const fn outcome(self) -> Outcome {
        Outcome::Rejected(match self {
            Self::Full(_) => Rejection::QueueFull,
            Self::NoGroup(_) => Rejection::Unsupported,
        })
    }
}

impl Session {
    /// A connection that nobody knows anything about.
    pub(crate) const fn new() -> Self {
        Self { phase: Phase::Stranger, groups: BTreeSet::new() }
    }

    /// It got an address.
    pub(crate) const fn registered(&mut self, tid: Tid) {
        self.phase = Phase::Waiting(tid);
    }

    /// The barrier has opened for it.
    pub(crate) const fn released(&mut self, tid: Tid) {
        self.phase = Phase::Open(tid);
    }

    /// It did not become a member of this group, for a reason that its frames do not show.
    pub(crate) fn has_not_joined(&mut self, group: AppAddress) {
        self.groups.remove(&group);
    }

    /// What a frame means.
    pub(crate) fn handle(&mut self, message: Message) -> Order {
        let order = match self.phase {
            Phase::Stranger => read_first(&message),
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
            Kind::LNCL_UNREGISTER => Ok(Order::Unregister),
            Kind::LNCL_REGISTER => Err(Violation::RegisteredTwice),
            // Not an enum of ours: an open set of numbers.
            _ => Err(Violation::NotForClients(kind)),
        };
        order.unwrap_or_else(Order::End)
    }

    fn read_group(&mut self, message: &Message) -> Result<Order, Violation> {
        let Group { group, member } = read_payload(message)?;
        let confirm = message.header.flags.has(Flags::CONFIRM).then_some(message.header.correlation);
        let refuse = |why: NoMembership| Order::Tell {
            destination: message.header.destination,
            correlation: message.header.correlation,
            outcome: why.outcome(),
            why,
        };
        if !group.is_group() {
            return Ok(refuse(NoMembership::NoGroup(group)));
        }
        if !member {
            self.groups.remove(&group);
        } else if self.groups.len() >= GROUPS_MAX && !self.groups.contains(&group) {
            return Ok(refuse(NoMembership::Full(group)));
        } else {
            self.groups.insert(group);
        }
        Ok(Order::SetMember { group, member, confirm })
    }
}

fn read_first(message: &Message) -> Result<Order, Violation> {
    if message.header.kind != Kind::LNCL_REGISTER {
        return Err(Violation::NotRegistered(message.header.kind));
    }
    read_payload(message).map(Order::Register)
}

fn read_early(message: &Message) -> Result<Order, Violation> {
    match message.header.kind {
        Kind::LNCL_UNREGISTER => Ok(Order::Unregister),
        Kind::LNCL_REGISTER => Err(Violation::RegisteredTwice),
        // Not an enum of ours: an open set of numbers.
        kind => Err(Violation::TooEarly(kind)),
    }
}

fn read_data(mut message: Message) -> Order {
    // The flag belongs to frames of kind OUTCOME alone; a message with it could be taken for one further on.
    // Of a Stream the newest wins, so an older one has no outcome of its own.
    let is_confirmed_stream =
        message.header.class == Class::Stream && message.header.flags.has(Flags::CONFIRM);
    if message.header.flags.has(Flags::OUTCOME) || is_confirmed_stream {
        return Order::RefuseMessage { message, why: Rejection::Unsupported };
    }
    // It was sent on this host.
    message.header.set_sent_error(Some(Duration::ZERO));
    Order::Route(message)
}

fn read_outcome(message: &Message) -> Result<Order, Violation> {
    let [code] = message.payload[..] else {
        return Err(malformed(message, &format!("{} bytes instead of one", message.payload.len())));
    };
    let outcome = Outcome::from_code(code)
        .ok_or_else(|| malformed(message, &format!("no outcome has the code {code}")))?;
    Ok(Order::Settle { source: message.header.destination, correlation: message.header.correlation, outcome })
}

fn read_resolve(message: &Message) -> Result<Order, Violation> {
    let Resolve { name, nearest } = read_payload(message)?;
    Ok(Order::Resolve { name, nearest, correlation: message.header.correlation })
}

fn read_introduce(message: &Message) -> Result<Order, Violation> {
    let Introduce { to } = read_payload(message)?;
    Ok(Order::Introduce { to: Tid::from_bits(to), correlation: message.header.correlation })
}

fn read_switch(message: &Message) -> Result<Order, Violation> {
    let Switch { peer, number } = read_payload(message)?;
    Ok(Order::Switch { to: Tid::from_bits(peer), number, correlation: message.header.correlation })
}

fn read_payload<P: serde::de::DeserializeOwned>(message: &Message) -> Result<P, Violation> {
    payload::read(&message.payload).map_err(|cause| malformed(message, &cause))
}

fn malformed(message: &Message, cause: &dyn std::fmt::Display) -> Violation {
    Violation::Malformed { kind: message.header.kind, cause: cause.to_string() }
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
        let mut session = Session::new();
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
    fn a_stranger_may_only_register() {
        let order = Session::new().handle(message(Kind::named("x"), Tid::NONE, b""));
        assert!(matches!(order, Order::End(Violation::NotRegistered(_))));
        let asked = payload::frame(Kind::LNCL_REGISTER, Tid::NONE, OTHER, &Register::default());
        assert!(matches!(Session::new().handle(asked), Order::Register(_)));
    }

    #[test]
    fn nothing_is_routed_before_the_barrier_opens() {
        let mut session = Session::new();
        session.registered(TID);
        let order = session.handle(message(Kind::named("x"), TID, b""));
        assert!(matches!(order, Order::End(Violation::TooEarly(_))));
        assert!(matches!(session.handle(message(Kind::LNCL_UNREGISTER, TID, b"")), Order::Unregister));
    }

    #[test]
    fn a_forged_source_costs_the_message_and_not_the_connection() {
        let mut session = open();
        let order = session.handle(message(Kind::named("x"), OTHER, b""));
        assert!(matches!(order, Order::RefuseMessage { why: Rejection::ForgedSource, .. }));
        assert!(matches!(session.handle(message(Kind::named("x"), TID, b"")), Order::Route(_)));
    }

    #[test]
    fn a_layers_kind_in_an_applications_mouth_ends_its_connection() {
        for kind in [Kind::SYNC_DIRECTORY, Kind::GNCL_HELLO, Kind::LNCL_REGISTERED, Kind::from_bits(0x7fff)] {
            let order = open().handle(message(kind, TID, b""));
            assert!(matches!(order, Order::End(Violation::NotForClients(_))), "{kind}");
        }
    }

    #[test]
    fn outcomes_are_one_byte_that_means_something() {
        let read = |payload: &[u8]| open().handle(message(Kind::OUTCOME, TID, payload));
        assert!(matches!(read(&[0]), Order::Settle { source: OTHER, outcome: Outcome::Delivered, .. }));
        for wrong in [&[][..], &[99], &[0, 0]] {
            assert!(matches!(read(wrong), Order::End(Violation::Malformed { .. })));
        }
    }

    #[test]
    fn a_client_is_in_a_bounded_number_of_groups() {
        let mut session = open();
        for n in 0..GROUPS_MAX {
            let order = session.handle(group(AppAddress::group(&n.to_string()), true));
            assert!(matches!(order, Order::SetMember { .. }));
        }
        let one_more = session.handle(group(AppAddress::group("one more"), true));
        let Order::Tell { outcome, why, .. } = one_more else { panic!("{one_more:?}") };
        let refused = Outcome::Rejected(Rejection::QueueFull);
        assert_eq!((outcome, why), (refused, NoMembership::Full(AppAddress::group("one more"))));
        assert!(why.to_string().contains("256 groups"), "{why}");
        session.handle(group(AppAddress::group("0"), false));
        let order = session.handle(group(AppAddress::group("one more"), true));
        assert!(matches!(order, Order::SetMember { .. }));
        // One that was refused for another reason takes no place.
        session.has_not_joined(AppAddress::group("one more"));
        let order = session.handle(group(AppAddress::group("another one"), true));
        assert!(matches!(order, Order::SetMember { .. }));
    }

    #[test]
    fn what_is_no_group_cannot_be_joined() {
        let order = open().handle(group(AppAddress::LNCL, true));
        let Order::Tell { outcome, why, .. } = order else { panic!("{order:?}") };
        let refused = Outcome::Rejected(Rejection::Unsupported);
        assert_eq!((outcome, why), (refused, NoMembership::NoGroup(AppAddress::LNCL)));
    }

    proptest! {
        #[test]
        fn any_payload_of_any_kind_is_an_order(kind in 0u32..0x50, payload: Vec<u8>, step in 0..3) {
            let mut session = Session::new();
            if step > 0 { session.registered(TID); }
            if step > 1 { session.released(TID); }
            session.handle(message(Kind::from_bits(kind), TID, &payload));
        }
    }
}
