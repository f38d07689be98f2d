//! The declaration of an endpoint's payload types to its node.
//!
//! Finding the structure of a type takes up to some milliseconds, once in a process. So a registration does not wait
//! for it: types with a known structure are declared before the registration returns, the others by a thread. Another
//! thread, of low priority, finds their structures. The frames are written with the priority of the registration: a
//! sender waits for the lock of the ring while one is written.

use std::{
    sync::{Arc, Weak},
    thread,
    time::Duration,
};

use sinew_model::thread_priority::lower_priority;
use sinew_protocol::payload::{self, TypeDeclaration};
use sinew_runtime::{
    log,
    tid::Tid,
    time::Time,
    wire::{Kind, Message, MismatchPolicy, PayloadType},
};

use super::{Progress, Writer};
use crate::ApiError;

/// Maximum number of declared types: the node keeps as many that an application handles, and as many that it sends.
const TYPES_MAX: usize = 128;
/// Time after which the declarations that find no room are given up. A long loan or a stopped node takes the room.
const WITHIN: Duration = Duration::from_secs(10);
/// Time between two tries of one declaration.
const PAUSE: Duration = Duration::from_millis(5);
/// Policy of a handled type without a Rust definition. Languages without exact numbers read more than they declare, so
/// their decoder decides.
const GIVEN_POLICY: MismatchPolicy = MismatchPolicy::Warn;
/// Prefix of the names of Sinew's own types, which layers keep compatible.
const OWN_PREFIX: &str = "sinew.";

/// The use of a type by an application.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Use {
    Handled,
    Sent,
}

/// The types that an application handles or sends, in the order of their registration.
#[derive(Clone, Debug, Default)]
pub(crate) struct UsedTypes(Vec<UsedType>);

#[derive(Clone, Debug)]
struct UsedType {
    of: TypeOf,
    is_handled: bool,
    is_sent: bool,
}

/// A type, and the origin of its structure.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum TypeOf {
    /// A type of Rust. Its structure is found when it is needed first.
    Rust(PayloadType),
    /// A type without a Rust definition, with the canonical bytes of its structure.
    Given { name: String, schema: Vec<u8> },
}

impl TypeOf {
    fn name(&self) -> &str {
        match self {
            Self::Rust(of) => of.name(),
            Self::Given { name, .. } => name,
        }
    }

    /// Returns whether the structure is known without a search.
    fn is_known(&self) -> bool {
        match self {
            Self::Rust(of) => of.is_traced(),
            Self::Given { .. } => true,
        }
    }
}

impl UsedTypes {
    /// Adds a use of a type. One beyond the maximum is not declared, and so not compared.
    pub(crate) fn add(&mut self, of: TypeOf, as_what: Use) {
        if of.name().starts_with(OWN_PREFIX) {
            return;
        }
        if !self.0.iter().any(|one| one.of == of) {
            if self.0.len() == TYPES_MAX {
                return;
            }
            self.0.push(UsedType { of: of.clone(), is_handled: false, is_sent: false });
        }
        for one in self.0.iter_mut().filter(|one| one.of == of) {
            one.is_handled |= as_what == Use::Handled;
            one.is_sent |= as_what == Use::Sent;
        }
    }

    /// Declares the types to the node of a new connection. Never waits.
    pub(super) fn declare(&self, own: Tid, payload_max: usize, writer: &Arc<Writer>) {
        let is_declared = |one: &&UsedType| {
            one.of.is_known() && declaration(one, own, payload_max).is_none_or(|frame| write(writer, &frame))
        };
        let rest: Vec<UsedType> = self.0.iter().filter(|one| !is_declared(one)).cloned().collect();
        if rest.is_empty() {
            return;
        }
        // Weak: the end of the endpoint closes its connection.
        let writer = Arc::downgrade(writer);
        let run = move || declare_later(&rest, own, payload_max, &writer);
        if let Err(why) = thread::Builder::new().name("types".to_owned()).spawn(run) {
            log::debug!("the types of {own} are not declared: {why}");
        }
    }
}

/// Finds the structures of these types on a thread of low priority. Returns their declarations.
fn declarations(types: &[UsedType], own: Tid, payload_max: usize) -> std::io::Result<Vec<(TypeOf, Message)>> {
    let find = move || {
        lower_priority();
        let all = types.iter().filter_map(|one| Some((one.of.clone(), declaration(one, own, payload_max)?)));
        all.collect()
    };
    thread::scope(|scope| {
        let found = thread::Builder::new().name("structures".to_owned()).spawn_scoped(scope, find)?;
        // Only the program's own `Deserialize` can panic there: its types are not declared.
        Ok(found.join().unwrap_or_default())
    })
}

/// Declares types as soon as their structures are known.
fn declare_later(types: &[UsedType], own: Tid, payload_max: usize, writer: &Weak<Writer>) {
    let found = match declarations(types, own, payload_max) {
        Ok(found) => found,
        Err(why) => return log::debug!("the types of {own} are not declared: {why}"),
    };
    // One limit for all types. Behind it each of the others is tried once.
    let until = Time::now() + WITHIN;
    for (of, frame) in found {
        loop {
            let Some(writer) = writer.upgrade() else { return };
            if write(&writer, &frame) {
                break;
            }
            drop(writer);
            if Time::now() >= until {
                log::debug!("type {} of {own} is not declared: no room within {WITHIN:?}", of.name());
                break;
            }
            thread::sleep(PAUSE);
        }
    }
}

/// Returns the frame that declares a type. `None`: its structure is not known, or too long for the node.
fn declaration(one: &UsedType, own: Tid, payload_max: usize) -> Option<Message> {
    let (kind, policy, protected, schema) = match &one.of {
        TypeOf::Rust(of) => {
            (of.kind(), of.mismatch(), of.is_protected(), of.schema().ok()?.schema().encode())
        }
        TypeOf::Given { name, schema } => (Kind::named(name), GIVEN_POLICY, false, schema.clone()),
    };
    let declaration = TypeDeclaration {
        kind,
        handles: one.is_handled,
        sends: one.is_sent,
        policy: policy.word().to_owned(),
        protected,
        schema,
    };
    let frame = payload::frame(Kind::LNCL_TYPE, own, payload::lncl_of(own.node), &declaration);
    (frame.payload.len() <= payload_max).then_some(frame)
}

/// Writes the frame if there is room for it now. Returns whether it need not be tried again.
fn write(writer: &Writer, frame: &Message) -> bool {
    match writer.offer(frame) {
        Ok(is_written) => is_written,
        // A send in progress, or a loan, holds the ring.
        Err(ApiError::LoanActive) => false,
        // The endpoint finds the error at its next call.
        Err(_) => true,
    }
}

impl Writer {
    /// Writes one frame if there is room for it now. Returns whether it was written.
    ///
    /// # Errors
    /// The connection has ended, or the ring is lent.
    fn offer(&self, message: &Message) -> Result<bool, ApiError> {
        match self {
            Self::Socket(writer) => {
                match writer.begin(Message::new(message.header, message.payload.clone()))? {
                    Progress::Whole => Ok(true),
                    Progress::Part(_) => {
                        // The task of the endpoint writes the rest. It may be asleep.
                        writer.pending_notify.notify_one();
                        Ok(true)
                    }
                    Progress::Full(_) => Ok(false),
                }
            }
            Self::Ring(writer) => writer.try_write(message),
        }
    }
}

#[cfg(test)]
mod tests {
    use serde::{Deserialize, Serialize};
    use sinew_runtime::{
        tid::{AppAddress, NodeAddress},
        wire::Payload,
    };

    use super::*;

    #[derive(Serialize, Deserialize)]
    struct Angle {
        degrees: f32,
    }

    impl Payload for Angle {
        const NAME: &'static str = "test.client_types.angle";
        const MISMATCH: MismatchPolicy = MismatchPolicy::Refuse;
    }

    #[derive(Serialize, Deserialize)]
    struct Speed {
        value: f32,
    }

    impl Payload for Speed {
        const NAME: &'static str = "test.client_types.speed";
    }

    #[derive(Serialize, Deserialize)]
    struct Own {}

    impl Payload for Own {
        const NAME: &'static str = "sinew.test.client_types";
    }

    const TID: Tid = Tid::new(NodeAddress::new(1), AppAddress::new(0x1000));

    #[test]
    fn type_is_declared_once_with_its_uses_and_policy() {
        let mut types = UsedTypes::default();
        let [angle, own] = [PayloadType::of::<Angle>(), PayloadType::of::<Own>()].map(|one| one.unwrap());
        types.add(TypeOf::Rust(angle), Use::Handled);
        types.add(TypeOf::Rust(own), Use::Handled);
        types.add(TypeOf::Rust(angle), Use::Sent);
        let [one] = &types.0[..] else { panic!("{types:?}") };
        let frame = declaration(one, TID, 4_096).expect("it has a structure");
        let read: TypeDeclaration = payload::read(&frame.payload).unwrap();
        let schema = angle.schema().unwrap().schema().encode();
        let policy = "refuse".to_owned();
        let expected = TypeDeclaration {
            kind: Angle::KIND,
            handles: true,
            sends: true,
            policy,
            protected: false,
            schema,
        };
        assert_eq!((frame.header.kind, read), (Kind::LNCL_TYPE, expected));
        assert!(angle.is_traced(), "another registration of this process need not wait for it");
        assert!(declaration(one, TID, frame.payload.len() - 1).is_none());
    }

    #[test]
    fn given_structure_is_declared_as_it_is() {
        let mut types = UsedTypes::default();
        let schema = PayloadType::of::<Angle>().unwrap().schema().unwrap().schema().encode();
        let given = TypeOf::Given { name: "test.client_types.given".to_owned(), schema: schema.clone() };
        types.add(given.clone(), Use::Sent);
        types.add(given, Use::Handled);
        let [one] = &types.0[..] else { panic!("{types:?}") };
        assert!(one.of.is_known());
        let frame = declaration(one, TID, 4_096).expect("it has a structure");
        let read: TypeDeclaration = payload::read(&frame.payload).unwrap();
        let kind = Kind::named("test.client_types.given");
        let expected = TypeDeclaration {
            kind,
            handles: true,
            sends: true,
            policy: "warn".to_owned(),
            protected: false,
            schema,
        };
        assert_eq!(read, expected);
    }

    #[test]
    fn structures_are_found_before_any_frame_is_written() {
        let mut types = UsedTypes::default();
        let speed = PayloadType::of::<Speed>().expect("the table has room");
        types.add(TypeOf::Rust(speed), Use::Sent);
        assert!(!speed.is_traced());
        let found = declarations(&types.0, TID, 4_096).expect("the system has a thread");
        assert_eq!(found.into_iter().map(|(of, _)| of).collect::<Vec<_>>(), [TypeOf::Rust(speed)]);
        assert!(speed.is_traced() && declarations(&types.0, TID, 1).is_ok_and(|found| found.is_empty()));
    }
}
