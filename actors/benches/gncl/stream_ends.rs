//! The sender of a value of class Stream on each channel every millisecond, and its receiver.

use std::{
    sync::{
        Arc, Mutex, PoisonError,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::Duration,
};

use serde::{Deserialize, Serialize};
use sinew::{Time, prelude::*};
use sinew_figures::Figures;

/// Period of a channel's values.
pub(crate) const PERIOD: Duration = Duration::from_millis(1);
/// Uncounted values of each channel at the start: datagrams are used after the first one was acknowledged.
const WARM_UP: u64 = 500;

/// How values go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum By {
    /// Each in a datagram of its own.
    Datagrams,
    /// All by the connection of the class.
    Connection,
}

impl By {
    pub(crate) const ALL: [Self; 2] = [Self::Datagrams, Self::Connection];

    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Datagrams => "datagrams",
            Self::Connection => "connection",
        }
    }
}

/// The number of values, and their transport.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Plan {
    pub(crate) by: By,
    pub(crate) channels: usize,
    /// Values of each channel that are counted.
    pub(crate) values: u64,
}

impl Plan {
    /// The number of the last value of each channel.
    const fn last(self) -> u64 {
        WARM_UP + self.values
    }

    fn node(self, node: NodeBuilder) -> NodeBuilder {
        node.configure(|config| config.gncl.datagrams = self.by == By::Datagrams)
    }

    fn channel(number: usize) -> String {
        format!("channel-{number}")
    }
}

/// Counters of the process or the host, which only grow.
pub(crate) type Meter = fn() -> [u64; 3];

/// The results of one end.
pub(crate) struct Seen {
    /// Ages of values when they were handled; empty at the sender.
    pub(crate) ages: Figures,
    /// How far the meter went on meanwhile.
    pub(crate) counted: [u64; 3],
}

/// Counts of the meter since its creation.
struct Metered {
    meter: Meter,
    began: [u64; 3],
}

impl Metered {
    fn begin(meter: Meter) -> Self {
        Self { meter, began: meter() }
    }

    fn end(&self) -> [u64; 3] {
        let now = (self.meter)();
        [0, 1, 2].map(|at| now[at] - self.began[at])
    }
}

#[derive(Serialize, Deserialize)]
struct Angles {
    number: u64,
    /// By the clock that all processes of a host have in common.
    sent_ns: u64,
    joints: [f64; 4],
}

impl Payload for Angles {
    const NAME: &'static str = "gncl.angles";
    const CLASS: Class = Class::Stream;
}

struct Giver {
    plan: Plan,
    to: Vec<Tid>,
    number: u64,
    meter: Meter,
    metered: Option<Metered>,
    done: SyncSender<Seen>,
}

impl Actor for Giver {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let to = (0..self.plan.channels).map(|number| context.resolve(&Plan::channel(number)));
        self.to = to.map(|to| to.expect("it is required")).collect();
        context.every(PERIOD, |giver: &mut Self, _, context: &mut AppContext<Self>| giver.give(context));
    }
}

impl Giver {
    fn give(&mut self, context: &AppContext<Self>) {
        if self.number > self.plan.last() {
            return;
        }
        if self.number == WARM_UP {
            self.metered = Some(Metered::begin(self.meter));
        }
        for to in &self.to {
            let sent_ns = Time::now().as_nanos();
            // A refused value is missing among the received ones.
            let _ = context.send(*to, &Angles { number: self.number, sent_ns, joints: [0.5; 4] });
        }
        self.number += 1;
        if self.number > self.plan.last()
            && let Some(metered) = &self.metered
        {
            let seen = Seen { ages: Figures::new(), counted: metered.end() };
            self.done.send(seen).expect("somebody waits for it");
        }
    }
}

/// The received values of all channels.
struct Taken {
    plan: Plan,
    meter: Meter,
    metered: Option<Metered>,
    ages: Figures,
    /// Channels that have got their last value.
    ended: usize,
    done: SyncSender<Seen>,
}

impl Taken {
    fn take(&mut self, angles: &Angles) {
        if angles.number < WARM_UP {
            return;
        }
        self.metered.get_or_insert_with(|| Metered::begin(self.meter));
        self.ages.record(Duration::from_nanos(Time::now().as_nanos().saturating_sub(angles.sent_ns)));
        self.ended += usize::from(angles.number == self.plan.last());
        if self.ended == self.plan.channels
            && let Some(metered) = self.metered.take()
        {
            let seen = Seen { ages: std::mem::take(&mut self.ages), counted: metered.end() };
            self.done.send(seen).expect("somebody waits for it");
        }
    }
}

struct Taker(Arc<Mutex<Taken>>);

impl Actor for Taker {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Angles>> for Taker {
    type Result = ();

    fn handle(&mut self, angles: Delivery<Angles>, _: &mut Self::Context) {
        // All receivers are on one thread.
        self.0.lock().unwrap_or_else(PoisonError::into_inner).take(&angles.payload);
    }
}

/// Runs this node as the receiver: each channel is an application on its IO thread. Its results are complete
/// when each channel has its last value.
pub(crate) fn taker(plan: Plan, node: NodeBuilder, meter: Meter) -> (Node, Receiver<Seen>) {
    let (done, seen) = sync_channel(1);
    let taken = Taken { plan, meter, metered: None, ages: Figures::new(), ended: 0, done };
    let taken = Arc::new(Mutex::new(taken));
    let app = |number| {
        let taken = taken.clone();
        AppSpec::new(Plan::channel(number), move || Taker(taken.clone())).handles::<Angles>().on_io_thread()
    };
    let node = (0..plan.channels).fold(plan.node(node), |node, number| node.app(app(number)));
    (node.start().expect("a node"), seen)
}

/// Runs this node as the sender. Its results are complete when the last value is sent.
pub(crate) fn giver(plan: Plan, node: NodeBuilder, meter: Meter) -> (Node, Receiver<Seen>) {
    let (done, seen) = sync_channel(1);
    let make = move || Giver { plan, to: Vec::new(), number: 0, meter, metered: None, done: done.clone() };
    let giver = AppSpec::new("giver", make).requires((0..plan.channels).map(Plan::channel)).own_thread();
    (plan.node(node).app(giver).start().expect("a node"), seen)
}
