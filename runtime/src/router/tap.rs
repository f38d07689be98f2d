//! Seeing what passes the routing table, while somebody watches.
//!
//! A [`Tap`] stands in the table itself, which every sender reads anyway: while there is none, a message costs one look at a pointer
//! that lies beside the table's root. It sees what is handed over in the node's process, which is all but what goes over the direct
//! links between other processes.

use std::sync::Arc;

use bytes::Bytes;

use super::Refused;
use crate::{
    outcome::Rejection,
    tid::Tid,
    wire::{Header, Message},
};

/// Whoever watches. It is called on the thread of whoever sends, so it never waits.
pub trait Tap: Send + Sync {
    /// Whether anybody watches what this application sends or gets.
    fn watches(&self, app: Tid) -> bool;

    /// A message from or for an application that is watched was handed over, or not.
    fn saw(&self, app: Tid, passage: &Passage<'_>);
}

/// A message that was handed over, or not.
#[derive(Clone, Copy, Debug)]
pub struct Passage<'a> {
    /// Which way, as its application sees it.
    pub way: Way,
    /// Its header.
    pub header: &'a Header,
    /// Its payload.
    pub payload: &'a Bytes,
    /// Why it was not taken; `None` if a queue or a connection has it.
    pub refused: Option<Rejection>,
}

/// Which way a message goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// To the application.
    In,
    /// From it.
    Out,
}

/// What is kept of a message, to be shown when it is known what became of it.
#[derive(Debug)]
pub(super) struct Look {
    header: Header,
    payload: Bytes,
    source: bool,
    target: bool,
}

impl Look {
    /// `None` if nobody watches either end, or it is no application's message.
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
        let passage = |way| Passage { way, header: &header, payload: &payload, refused };
        if source {
            tap.saw(header.source, &passage(Way::Out));
        }
        if target {
            tap.saw(header.destination, &passage(Way::In));
        }
    }
}

/// Hands a message to one outlet, and shows it to whoever watches. One that is refused for want of room and will be offered again is
/// shown then.
#[inline]
pub(super) fn hand_over(
    tap: Option<&Arc<dyn Tap>>,
    message: Message,
    is_offer: bool,
    take: impl FnOnce(Message) -> Result<(), Refused>,
) -> Result<(), Refused> {
    let Some(tap) = tap else { return take(message) };
    hand_over_watched(&**tap, message, is_offer, take)
}

#[cold]
fn hand_over_watched(
    tap: &dyn Tap,
    message: Message,
    is_offer: bool,
    take: impl FnOnce(Message) -> Result<(), Refused>,
) -> Result<(), Refused> {
    let look = Look::at(tap, &message);
    let result = take(message);
    let refused = result.as_ref().err().map(|refused| refused.why);
    if let Some(look) = look
        && !(is_offer && refused == Some(Rejection::QueueFull))
    {
        look.show(tap, refused);
    }
    result
}

/// One message to many, as its sender sees it: once.
pub(super) fn saw_sent_to_many(tap: Option<&Arc<dyn Tap>>, message: &Message) {
    let Some(tap) = tap else { return };
    if message.header.kind.is_user() && tap.watches(message.header.source) {
        let Message { header, payload, .. } = message;
        tap.saw(header.source, &Passage { way: Way::Out, header, payload, refused: None });
    }
}

/// One message to many, as one of them sees it.
pub(super) fn saw_one_of_many(
    tap: Option<&Arc<dyn Tap>>,
    member: Tid,
    message: &Message,
    refused: Option<Rejection>,
) {
    let Some(tap) = tap else { return };
    if message.header.kind.is_user() && tap.watches(member) {
        let Message { header, payload, .. } = message;
        tap.saw(member, &Passage { way: Way::In, header, payload, refused });
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;
    use crate::{
        post::lock,
        router::{LocalRoute, Outlet, Router},
        tid::{AppAddress, NodeAddress},
        wire::{Kind, Message},
    };

    const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);
    const WATCHED: AppAddress = AppAddress::new(0x1001);
    const OTHER: AppAddress = AppAddress::new(0x1002);

    /// Takes all but for one kind, of which it says that there is no room.
    struct Picky;

    const FULL: Kind = Kind::named("test.full");

    impl Outlet for Picky {
        fn submit(&self, message: Message) -> Result<(), Refused> {
            if message.header.kind == FULL {
                Err(Refused::new(message, Rejection::QueueFull))
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
    }

    fn router() -> (Router, Arc<Notes>) {
        let router = Router::new(NODE);
        for app in [WATCHED, OTHER] {
            router.set_local(app, LocalRoute { outlet: Arc::new(Picky), events: Arc::new([]) });
        }
        let notes = Arc::new(Notes::default());
        router.set_tap(Some(notes.clone()));
        (router, notes)
    }

    fn message(kind: Kind, source: AppAddress, destination: AppAddress) -> Message {
        Message::new(Header::new(kind, Tid::new(NODE, source), Tid::new(NODE, destination)), Bytes::new())
    }

    #[test]
    fn what_an_application_gets_and_sends_is_seen_with_what_becomes_of_it_and_nothing_of_others() {
        let (router, notes) = router();
        let any = Kind::named("test.any");
        let nobody = AppAddress::new(0x1fff);
        router.send(message(any, OTHER, WATCHED)).expect("it is taken");
        router.send(message(any, OTHER, OTHER)).expect("it is taken");
        router.send(message(FULL, WATCHED, OTHER)).expect_err("it is full");
        router.send(message(any, WATCHED, nobody)).expect_err("nobody is there");
        router.deliver(message(any, OTHER, WATCHED)).expect("it is taken");
        // Layers' own words are none of the watcher's.
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
        router.set_tap(None);
        router.send(message(any, OTHER, WATCHED)).expect("it is taken");
        assert!(lock(&notes.0).is_empty(), "nobody watches any more");
    }

    #[test]
    fn what_is_offered_again_and_again_is_seen_when_it_is_taken() {
        let (router, notes) = router();
        let refused = router.offer(message(FULL, OTHER, WATCHED), None).expect_err("it is full");
        let mut again = refused.message;
        again.header.kind = Kind::named("test.any");
        router.offer(again, None).expect("it is taken");
        assert_eq!(*lock(&notes.0), [(Way::In, Kind::named("test.any"), None)]);
    }

    #[test]
    fn a_message_to_a_group_is_seen_once_by_who_watches_its_source_or_a_member() {
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
