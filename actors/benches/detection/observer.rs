//! The watching node, and its events.

use std::{
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    time::Duration,
};

use sinew::{NodeHandle, message::Sender, prelude::*};

use crate::{
    nodes::At,
    setting::Setting,
    subject::{Held, Hold, SUBJECT},
};

/// No wait is longer.
pub(crate) const DEADLINE: Duration = Duration::from_secs(60);
/// Maximum number of events that wait to be checked; each trial takes a few.
const HEARD_MAX: usize = 1_024;
/// Poll interval for states without an event.
const LOOK: Duration = Duration::from_millis(1);

/// An event of the observer's application.
enum Heard {
    Event(Told),
    Held(Time),
}

/// An event, and when the application had it.
#[derive(Debug)]
pub(crate) struct Told {
    pub(crate) at: Time,
    /// When NDL handed it over.
    pub(crate) sent: Time,
    pub(crate) event: NodeEvent,
}

struct Watch {
    heard: SyncSender<Heard>,
    sender: SyncSender<Sender>,
}

impl Actor for Watch {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.sender.try_send(context.sender()).expect("the only start of this application");
    }
}

impl Handler<Delivery<NodeEvent>> for Watch {
    type Result = ();

    fn handle(&mut self, event: Delivery<NodeEvent>, _: &mut Self::Context) {
        let told = Told { at: Time::now(), sent: event.sent.expect("of this host"), event: event.payload };
        self.heard.try_send(Heard::Event(told)).expect("fewer events than that in a trial");
    }
}

impl Handler<Delivery<Held>> for Watch {
    type Result = ();

    fn handle(&mut self, held: Delivery<Held>, _: &mut Self::Context) {
        let since = Time::from_nanos(held.payload.since_ns);
        self.heard.try_send(Heard::Held(since)).expect("one for each trial");
    }
}

/// The node that watches.
pub(crate) struct Observer {
    node: Node,
    sender: Sender,
    heard: Receiver<Heard>,
}

impl Observer {
    /// Starts it on the host of the calling thread.
    pub(crate) fn start(setting: Setting, at: At) -> Self {
        let ((tell, heard), (hand, sender)) = (sync_channel(HEARD_MAX), sync_channel(1));
        let watch = move || Watch { heard: tell.clone(), sender: hand.clone() };
        let watch = AppSpec::new("observer", watch).handles::<NodeEvent>().handles::<Held>().own_thread();
        let node = at.node("observer").app(watch).configure(|config| setting.write_to(config));
        let node = node.start().expect("a node");
        let sender = sender.recv_timeout(DEADLINE).expect("its application starts");
        Self { node, sender, heard }
    }

    /// Its node.
    pub(crate) fn handle(&self) -> NodeHandle {
        self.node.handle()
    }

    /// The next event.
    pub(crate) fn next(&self, what: &str) -> Told {
        loop {
            match self.heard.recv_timeout(DEADLINE) {
                Ok(Heard::Event(told)) => return told,
                // From a turn that ended with its incarnation.
                Ok(Heard::Held(_)) => {}
                Err(_) => panic!("{what} was not told within {DEADLINE:?}"),
            }
        }
    }

    /// Returns the events that no trial has waited for.
    pub(crate) fn rest(&self) -> Vec<NodeEvent> {
        let event = |heard| match heard {
            Heard::Event(told) => Some(told.event),
            Heard::Held(_) => None,
        };
        self.heard.try_iter().filter_map(event).collect()
    }

    /// Waits until messages reach the subject's application: the link is up, and names are known.
    pub(crate) fn reaches_subject(&self) {
        let until = Time::now() + DEADLINE;
        let is_ready = || self.handle().directory().iter().any(|entry| entry.name == SUBJECT && entry.ready);
        while !is_ready() {
            assert!(Time::now() < until, "no message reached the subject within {DEADLINE:?}");
            std::thread::sleep(LOOK);
        }
    }

    /// Makes a turn of the subject's application last this long. Returns its start.
    pub(crate) fn hold(&self, spins: bool, lasts: Duration) -> Time {
        let for_us = u64::try_from(lasts.as_micros()).expect("some seconds");
        self.sender.send(SUBJECT, &Hold { spins, for_us }).expect("it was reached");
        match self.heard.recv_timeout(DEADLINE) {
            Ok(Heard::Held(since)) => since,
            Ok(Heard::Event(told)) => panic!("{told:?} came before the turn began"),
            Err(_) => panic!("the subject's application did not begin within {DEADLINE:?}"),
        }
    }
}
