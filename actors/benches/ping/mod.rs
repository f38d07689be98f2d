//! Two applications that send a block there and back.

use std::{
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize};
use sinew::prelude::*;
use sinew_figures::{Figures, Rounds};

/// No wait of a bench is longer.
pub(crate) const DEADLINE: Duration = Duration::from_secs(60);

#[derive(Serialize, Deserialize)]
pub(crate) struct There {
    #[serde(with = "serde_bytes")]
    pub(crate) block: Vec<u8>,
}

impl Payload for There {
    const NAME: &'static str = "bench.there";
}

#[derive(Serialize, Deserialize)]
pub(crate) struct Back {
    #[serde(with = "serde_bytes")]
    pub(crate) block: Vec<u8>,
}

impl Payload for Back {
    const NAME: &'static str = "bench.back";
}

pub(crate) struct Echo;

impl Actor for Echo {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<There>> for Echo {
    type Result = ();

    fn handle(&mut self, there: Delivery<There>, context: &mut Self::Context) {
        let source = there.source;
        context.send(source, &Back { block: there.payload.block }).expect("the measuring end takes it");
    }
}

pub(crate) struct Ping {
    to: Option<Tid>,
    rounds: Rounds,
    round: u32,
    sent: Instant,
    figures: Figures,
    done: SyncSender<Figures>,
}

impl Ping {
    fn ping(&mut self, context: &AppContext<Self>) {
        self.sent = Instant::now();
        let to = self.to.expect("it was found at the start");
        context.send(to, &There { block: vec![7; self.rounds.bytes] }).expect("the echo takes it");
    }
}

impl Actor for Ping {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.to = context.resolve("echo");
        self.ping(context);
    }
}

impl Handler<Delivery<Back>> for Ping {
    type Result = ();

    fn handle(&mut self, back: Delivery<Back>, context: &mut Self::Context) {
        assert_eq!(back.block.len(), self.rounds.bytes);
        if self.round >= self.rounds.warm_up {
            self.figures.record(self.sent.elapsed());
        }
        self.round += 1;
        if self.round == self.rounds.warm_up + self.rounds.counted {
            self.done.send(std::mem::take(&mut self.figures)).expect("somebody waits for the figures");
        } else if self.rounds.pace.pause().is_zero() {
            self.ping(context);
        } else {
            context.after(self.rounds.pace.pause(), |ping, _, context| ping.ping(context));
        }
    }
}

/// The echoing application, `echo`.
pub(crate) fn echo() -> AppSpec<Echo> {
    AppSpec::new("echo", || Echo).handles::<There>()
}

/// The measuring application, and the channel of its results.
pub(crate) fn ping(rounds: Rounds) -> (AppSpec<Ping>, Receiver<Figures>) {
    let (done, figures) = sync_channel(1);
    let make = move || Ping {
        to: None,
        rounds,
        round: 0,
        sent: Instant::now(),
        figures: Figures::new(),
        done: done.clone(),
    };
    (AppSpec::new("ping", make).handles::<Back>().requires(["echo"]), figures)
}
