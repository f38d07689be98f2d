//! Observation of messages at the routing table, while there is an observer.
//!
//! A [`Tap`] is stored in the table itself, which every sender reads anyway: without one, a message costs one
//! read of a pointer beside the table's root. It sees the messages that are handed over in the node's
//! process. Those on direct links between other processes are reported to it:
//! [`Router::observe`](super::Router::observe).

use std::sync::Arc;

use bytes::Bytes;

use super::SubmitError;
use crate::{
    outcome::Rejection,
    tid::Tid,
    wire::{Header, Message},
};

/// An observer of messages. It is called on the sending thread, so it must never block.
pub trait Tap: Send + Sync {
    /// Returns whether messages from or to this application are observed.
    fn watches(&self, app: Tid) -> bool;

    /// Receives a message from or to an observed application, which was accepted or rejected.
    fn saw(&self, app: Tid, passage: &Passage<'_>);

    /// Records messages from or to an observed application that could not be reported.
    fn missed(&self, app: Tid, messages: u64);
}

/// The purpose of a tap: a table has at most one for each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TapOf {
    /// The watches of the inspection.
    Watches,
    /// The recording.
    Recording,
}

/// The number of purposes.
pub(super) const TAPS: usize = 2;

/// Returns one tap in place of all of them.
pub(super) fn joined(taps: &[Option<Arc<dyn Tap>>; TAPS]) -> Option<Arc<dyn Tap>> {
    match taps {
        [Some(one), Some(other)] => Some(Arc::new(Both([one.clone(), other.clone()]))),
        [one, other] => one.as_ref().or(other.as_ref()).cloned(),
    }
}

/// Several taps, of which each sees the messages of its own applications.
struct Both([Arc<dyn Tap>; TAPS]);

impl Tap for Both {
    fn watches(&self, app: Tid) -> bool {
        self.0.iter().any(|tap| tap.watches(app))
    }

    fn saw(&self, app: Tid, passage: &Passage<'_>) {
        self.0.iter().filter(|tap| tap.watches(app)).for_each(|tap| tap.saw(app, passage));
    }

    fn missed(&self, app: Tid, messages: u64) {
        self.0.iter().filter(|tap| tap.watches(app)).for_each(|tap| tap.missed(app, messages));
    }
}

/// A message that was accepted or rejected.
#[derive(Clone, Copy, Debug)]
pub struct Passage<'a> {
    /// The direction, from the application's side.
    pub way: Way,
    /// The header of the message.
    pub header: &'a Header,
    /// The payload of the message; empty if it was not reported because of its length.
    pub payload: &'a Bytes,
    /// Bytes of the payload.
    pub length: usize,
    /// The reason of the rejection; `None` if a queue or a connection accepted the message.
    pub refused: Option<Rejection>,
}

/// The direction of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// To the application.
    In,
    /// From the application.
    Out,
}

/// The parts of a message that are kept until its result is known.
#[derive(Debug)]
pub(super) struct ObservedMessage {
    header: Header,
    payload: Bytes,
    source: bool,
    target: bool,
}

impl ObservedMessage {
    /// Returns `None` if neither end is observed, or if it is no application's message.
    fn at(tap: &dyn Tap, message: &Message) -> Option<Self> {
        let Header { source, destination, kind, .. } = message.header;
        let (is_out, is_in) = (tap.watches(source), tap.watches(destination));
        let is_shown = kind.is_user() && (is_out || is_in);
        is_shown.then(|| Self {
            header: message.header,
            payload: message.payload.clone(),
            source: is_out,
            target: is_in,
        })
    }

    fn show(self, tap: &dyn Tap, refused: Option<Rejection>) {
        let Self { header, payload, source, target } = self;
        let length = payload.len();
        let passage = |way| Passage { way, header: &header, payload: &payload, length, refused };
        if source {
            tap.saw(header.source, &passage(Way::Out));
        }
        if target {
            tap.saw(header.destination, &passage(Way::In));
        }
    }
}

/// Hands a message to one sink, and reports it to the observer. A message that is rejected for lack of room
/// and will be offered again is reported at that later time.
#[cold]
pub(super) fn hand_over(
    tap: &dyn Tap,
    message: Message,
    is_offer: bool,
    take: impl FnOnce(Message) -> Result<(), SubmitError>,
) -> Result<(), SubmitError> {
    let observed = ObservedMessage::at(tap, &message);
    let result = take(message);
    let refused = result.as_ref().err().map(|refused| refused.why);
    if let Some(observed) = observed
        && !(is_offer && refused == Some(Rejection::QueueFull))
    {
        observed.show(tap, refused);
    }
    result
}

/// Reports one message to many for its sender, once.
pub(super) fn saw_sent_to_many(tap: Option<&Arc<dyn Tap>>, message: &Message) {
    let Some(tap) = tap else { return };
    if message.header.kind.is_user() && tap.watches(message.header.source) {
        let Message { header, payload, .. } = message;
        let length = payload.len();
        tap.saw(header.source, &Passage { way: Way::Out, header, payload, length, refused: None });
    }
}

/// Reports one message to many for one of its members.
pub(super) fn saw_one_of_many(
    tap: Option<&Arc<dyn Tap>>,
    member: Tid,
    message: &Message,
    refused: Option<Rejection>,
) {
    let Some(tap) = tap else { return };
    if message.header.kind.is_user() && tap.watches(member) {
        let Message { header, payload, .. } = message;
        let length = payload.len();
        tap.saw(member, &Passage { way: Way::In, header, payload, length, refused });
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;
    use crate::{
        lock,
        router::{LocalRoute, MessageSink, Router},
        tid::{AppAddress, NodeAddress},
        wire::{Kind, Message},
    };

    const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);
    const WATCHED: AppAddress = AppAddress::new(0x1001);
    const OTHER: AppAddress = AppAddress::new(0x1002);

    /// Accepts all kinds except one, which it rejects for lack of room.
    struct Picky;

    const FULL: Kind = Kind::named("test.full");

    impl MessageSink for Picky {
        fn submit(&self, message: Message) -> Result<(), SubmitError> {
            if message.header.kind == FULL {
                Err(SubmitError::new(message, Rejection::QueueFull))
            } else {
                Ok(())
            }
        }
    }

    #[derive(Default)]
    struct Notes(Mutex<Vec<(Way, Kind, Option<Rejection>)>>);

    impl Tap for Notes {
        fn watches(&self, app: Tid) -> bool {
            app.app == WATCHED
        }

        fn saw(&self, app: Tid, passage: &Passage<'_>) {
            assert_eq!(app, Tid::new(NODE, WATCHED));
            lock(&self.0).push((passage.way, passage.header.kind, passage.refused));
        }

        fn missed(&self, _: Tid, _: u64) {}
    }

    fn router() -> (Router, Arc<Notes>) {
        let router = Router::new(NODE);
        for app in [WATCHED, OTHER] {
            router.set_local(app, LocalRoute { sink: Arc::new(Picky), events: Arc::new([]) });
        }
        let notes = Arc::new(Notes::default());
        router.set_tap(TapOf::Watches, Some(notes.clone()));
        (router, notes)
    }

    fn message(kind: Kind, source: AppAddress, destination: AppAddress) -> Message {
        Message::new(Header::new(kind, Tid::new(NODE, source), Tid::new(NODE, destination)), Bytes::new())
    }

    #[test]
    fn tap_sees_messages_of_its_app_with_results() {
        let (router, notes) = router();
        let any = Kind::named("test.any");
        let nobody = AppAddress::new(0x1fff);
        router.send(message(any, OTHER, WATCHED)).expect("it is taken");
        router.send(message(any, OTHER, OTHER)).expect("it is taken");
        router.send(message(FULL, WATCHED, OTHER)).expect_err("it is full");
        router.send(message(any, WATCHED, nobody)).expect_err("nobody is there");
        router.deliver(message(any, OTHER, WATCHED)).expect("it is taken");
        // Messages of the layers are not seen by the watcher.
        router.send(message(Kind::OUTCOME, OTHER, WATCHED)).expect("it is taken");
        let seen = std::mem::take(&mut *lock(&notes.0));
        assert_eq!(
            seen,
            [
                (Way::In, any, None),
                (Way::Out, FULL, Some(Rejection::QueueFull)),
                (Way::Out, any, Some(Rejection::NoSuchApplication)),
                (Way::In, any, None),
            ]
        );
        router.set_tap(TapOf::Watches, None);
        router.send(message(any, OTHER, WATCHED)).expect("it is taken");
        assert!(lock(&notes.0).is_empty(), "nobody watches any more");
    }

    #[test]
    fn two_taps_see_the_messages_side_by_side() {
        let (router, watch) = router();
        let recording = Arc::new(Notes::default());
        router.set_tap(TapOf::Recording, Some(recording.clone()));
        let any = Kind::named("test.any");
        let send = || router.send(message(any, OTHER, WATCHED)).expect("it is taken");
        let counts = || [lock(&watch.0).len(), lock(&recording.0).len()];
        send();
        assert_eq!(counts(), [1, 1]);
        router.set_tap(TapOf::Watches, None);
        send();
        assert_eq!(counts(), [1, 2]);
        router.set_tap(TapOf::Watches, Some(watch.clone()));
        router.set_tap(TapOf::Recording, None);
        send();
        assert_eq!(counts(), [2, 2]);
        router.set_tap(TapOf::Watches, None);
        send();
        assert_eq!(counts(), [2, 2]);
    }

    #[test]
    fn retried_message_is_seen_when_it_is_accepted() {
        let (router, notes) = router();
        let refused = router.offer(message(FULL, OTHER, WATCHED), None).expect_err("it is full");
        let mut again = refused.message;
        again.header.kind = Kind::named("test.any");
        router.offer(again, None).expect("it is taken");
        assert_eq!(*lock(&notes.0), [(Way::In, Kind::named("test.any"), None)]);
    }

    #[test]
    fn group_message_is_seen_once_by_source_or_member() {
        let (router, notes) = router();
        let group = AppAddress::group("knees");
        for app in [WATCHED, OTHER] {
            router.set_member(group, app, true);
        }
        let any = Kind::named("test.any");
        let to_group = |source| {
            let mut message = message(any, source, group);
            message.header.destination.node = NodeAddress::ALL;
            message
        };
        router.send(to_group(WATCHED)).expect("a member takes it");
        router.send(to_group(OTHER)).expect("a member takes it");
        router.deliver(to_group(OTHER)).expect("members take it");
        assert_eq!(*lock(&notes.0), [(Way::Out, any, None), (Way::In, any, None), (Way::In, any, None)]);
    }
}
