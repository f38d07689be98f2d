//! Carries the core's orders out, on whatever thread has news for it.

use sinew_runtime::{
    mailbox::About,
    monitor::{Down, DownClass},
    outcome::Rejection,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Header, Kind, Message, Payload, decode},
};

use super::{
    core::{Core, Input, Output},
    words::write,
};
use crate::{
    aftermath,
    gncl::LinkFact,
    ndl::{LossReason, MembershipFact},
    stores::{Stores, lock},
    sync,
};

impl From<&MembershipFact> for Input {
    fn from(fact: &MembershipFact) -> Self {
        match fact {
            MembershipFact::NodeFound { node, incarnation, .. } => {
                Self::NodeFound { node: *node, incarnation: *incarnation }
            }
            MembershipFact::NodeLost { node, incarnation, why } => {
                let (node, incarnation) = (*node, *incarnation);
                let why = match why {
                    LossReason::GaveUp(words) => return Self::gave_up(node, incarnation, words),
                    LossReason::Left => "its node left",
                    LossReason::Crashed => "its node was lost: its process ended",
                    LossReason::Hung => "its node was lost: it hangs, while its host answers",
                    LossReason::LinkDown => "its node was lost: neither it nor its host answers",
                    LossReason::Restarted => "its node was restarted",
                    LossReason::Duplicate => "its node is none: another process holds that node address",
                };
                Self::NodeLost { node, incarnation, why: why.into() }
            }
        }
    }
}

impl Input {
    fn gave_up(node: NodeAddress, incarnation: Incarnation, words: &str) -> Self {
        Self::NodeLost { node, incarnation, why: format!("its node gave up: {words}").into() }
    }

    /// What a link's change is to monitors; `None`: nothing.
    pub(crate) fn of_link(fact: &LinkFact) -> Option<Self> {
        match *fact {
            LinkFact::LinkUp { node, incarnation } => Some(Self::LinkUp { node, incarnation }),
            LinkFact::LinkBroken { node, incarnation } => Some(Self::LinkBroken { node, incarnation }),
            LinkFact::PeerLeft { node, incarnation, gave_up: Some(ref words) } => {
                Some(Self::gave_up(node, incarnation, words.as_str()))
            }
            LinkFact::PeerLeft { node, incarnation, gave_up: None } => {
                Some(Self::NodeLost { node, incarnation, why: "its node left".into() })
            }
            LinkFact::DialRefused { .. } => None,
        }
    }
}

/// Tells the core what has happened and carries out what follows. Not for who holds a lock of the node's: messages are
/// sent.
pub(crate) fn feed(stores: &Stores, input: Input) {
    change(stores, |core| core.handle(Time::now(), input));
}

/// Changes the core and carries out what follows.
pub(crate) fn change<T>(stores: &Stores, change: impl FnOnce(&mut Core) -> T) -> T {
    let (said, is_earlier) = {
        let mut core = lock(&stores.monitors);
        let before = core.next_wake();
        let said = change(&mut core);
        (said, core.next_wake().is_some_and(|wake| before.is_none_or(|before| wake < before)))
    };
    drain(stores);
    if is_earlier {
        poke(stores);
    }
    said
}

/// The same for who holds a lock: what follows is carried out by the sync manager.
pub(crate) fn note(stores: &Stores, input: Input) {
    let has_orders = {
        let mut core = lock(&stores.monitors);
        core.handle(Time::now(), input);
        core.has_orders()
    };
    if has_orders {
        poke(stores);
    }
}

/// Notes what has happened while the orders are being carried out.
fn note_undrained(stores: &Stores, input: Input) {
    let is_earlier = {
        let mut core = lock(&stores.monitors);
        let before = core.next_wake();
        core.handle(Time::now(), input);
        core.next_wake().is_some_and(|wake| before.is_none_or(|before| wake < before))
    };
    if is_earlier {
        poke(stores);
    }
}

/// Whether there is something to [carry out](drain).
pub(crate) fn has_orders(stores: &Stores) -> bool {
    lock(&stores.monitors).has_orders()
}

/// Carries out what the core orders.
pub(crate) fn drain(stores: &Stores) {
    loop {
        let Some(output) = lock(&stores.monitors).poll() else { return };
        match output {
            Output::Tell { watcher, down } => tell(stores, watcher, down),
            Output::Watch { to, watch } => say(stores, to, Kind::SYNC_WATCH, write(&watch)),
            Output::Lives { to, lives } => {
                for part in lives.in_parts(stores.config.payload_max) {
                    say(stores, to, Kind::SYNC_LIVES, write(&part));
                }
            }
        }
    }
}

/// When the sync manager has to say that time has passed.
pub(crate) fn next_wake(stores: &Stores) -> Option<Time> {
    lock(&stores.monitors).next_wake()
}

/// Takes a frame of another node's sync manager.
///
/// # Errors
/// What is wrong with it, in words.
pub(crate) fn receive(stores: &Stores, from: NodeAddress, message: &Message) -> Result<(), String> {
    let in_words = |error: rmp_serde::decode::Error| format!("from {from}: {error}");
    let input = match message.header.kind {
        Kind::SYNC_WATCH => Input::Watch { from, watch: decode(&message.payload).map_err(in_words)? },
        Kind::SYNC_LIVES => Input::Lives { from, lives: decode(&message.payload).map_err(in_words)? },
        kind => return Err(format!("{from} sent kind {kind}")),
    };
    feed(stores, input);
    Ok(())
}

fn poke(stores: &Stores) {
    if stores.posts.sync.post(sync::Event::Monitors).is_err() {
        crate::log::error!("the sync manager's post is full; monitors are looked at late: does it hang?");
    }
}

fn tell(stores: &Stores, watcher: AppAddress, down: Down) {
    let mut message =
        Message::new(header(stores, Down::KIND, stores.node, watcher), sinew_runtime::wire::encode(&down));
    message.header.class = Down::CLASS;
    let told = if down.class == DownClass::NodeLost {
        aftermath::tell(stores, About::End(down.tid.node), message)
    } else {
        stores.router.send(message)
    };
    if let Err(Rejection::QueueFull) = told {
        // Any other refusal says that the watcher is gone, and its monitors go with it.
        // What follows is carried out by whoever drains now, not within this: a thousand of these are no deep stack.
        note_undrained(stores, Input::NotTaken { watcher, down });
    }
}

fn say(stores: &Stores, to: NodeAddress, kind: Kind, payload: bytes::Bytes) {
    // Not taken: it is said again within 2 s, and when the link is back.
    let _ = stores.router.send(Message::new(header(stores, kind, to, AppAddress::SYNC), payload));
}

fn header(stores: &Stores, kind: Kind, node: NodeAddress, app: AppAddress) -> Header {
    let mut header = Header::new(kind, Tid::new(stores.node, AppAddress::SYNC), Tid::new(node, app));
    header.sequence = lock(&stores.sync).next_sequence();
    header.sent = Time::now();
    header
}

#[cfg(test)]
mod tests {
    use std::sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    };

    use sinew_runtime::{
        router::{LocalRoute, Outlet, Refused},
        tid::Incarnation,
    };

    use super::*;
    use crate::{
        config::NodeConfig,
        monitors::{Cause, core::PER_WATCHER_MAX},
    };

    const WATCHERS: u32 = 15;

    /// A mailbox that is full, and between which addresses of the stack it was asked.
    #[derive(Default)]
    struct Full {
        refused: AtomicUsize,
        deepest: AtomicUsize,
        highest: AtomicUsize,
    }

    impl Outlet for Full {
        fn submit(&self, message: Message) -> Result<(), Refused> {
            let mark = 0_u8;
            let at = std::ptr::from_ref(&mark).addr();
            self.refused.fetch_add(1, Ordering::Relaxed);
            self.highest.fetch_max(at, Ordering::Relaxed);
            // So that the least value is the first: the stack grows downwards.
            self.deepest.fetch_max(usize::MAX - at, Ordering::Relaxed);
            Err(Refused::new(message, Rejection::QueueFull))
        }
    }

    /// All these monitors end at once, and nobody has room: each refusal is an event of its own while the rest is told.
    fn ends_that_nobody_takes() -> Arc<Full> {
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let (target, full) = (AppAddress::fixed(0).expect("a fixed one"), Arc::new(Full::default()));
        feed(&stores, Input::Began { app: target });
        for index in 1..=WATCHERS {
            let watcher = AppAddress::fixed(index).expect("a fixed one");
            stores.router.set_local(watcher, LocalRoute { outlet: full.clone(), events: Arc::new([]) });
            for _ in 0..PER_WATCHER_MAX {
                let set =
                    change(&stores, |core| core.monitor(Time::now(), watcher, Tid::new(stores.node, target)));
                set.expect("there is room for so many");
            }
        }
        let cause = Cause::new(DownClass::Panic, "its end");
        feed(&stores, Input::Ended { app: target, cause, is_gone: true });
        full
    }

    #[test]
    fn ends_that_no_watcher_has_room_for_need_no_deeper_stack_than_one() {
        // Room enough, so that a stack that is too deep fails this test and no other.
        let thread = std::thread::Builder::new().stack_size(1 << 28).spawn(ends_that_nobody_takes);
        let full = thread.expect("a thread").join().expect("it does not panic");
        assert_eq!(full.refused.load(Ordering::Relaxed), WATCHERS as usize * PER_WATCHER_MAX);
        let deepest = usize::MAX - full.deepest.load(Ordering::Relaxed);
        let depth = full.highest.load(Ordering::Relaxed) - deepest;
        assert!(depth < 16 * 1024, "{depth} bytes of stack between the first refusal and the deepest one");
    }
}
