//! What a supervisor tells of its children as events: whose life it was, which one, and what waits.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

#[expect(dead_code, reason = "other tests and the benches need more of it")]
mod stage;

use std::{
    fmt::Write as _,
    sync::{
        Arc, Mutex,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
};

use actix::{Actor, ActorContext, Handler};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    supervision::Restart,
};
use stage::{DEADLINE, Number, Stage};
use tracing::{
    Event, Metadata, Subscriber,
    field::{Field, Visit},
    span,
};

/// Stops with the first message in its hand, when it may.
struct Mortal(Arc<Mutex<Receiver<()>>>);

impl Actor for Mortal {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Number>> for Mortal {
    type Result = ();

    fn handle(&mut self, _: Delivery<Number>, context: &mut Self::Context) {
        self.0.lock().unwrap().recv_timeout(DEADLINE).expect("it may");
        context.stop();
    }
}

struct Reader(SyncSender<String>);

struct Words(String);

impl Visit for Words {
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        write!(self.0, "{field}={value:?} ").unwrap();
    }
}

impl Subscriber for Reader {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        metadata.target().starts_with("sinew_runtime::supervision")
    }

    fn event(&self, event: &Event<'_>) {
        let mut words = Words(String::new());
        event.record(&mut words);
        // Whoever has seen enough reads no more.
        let _ = self.0.send(words.0);
    }

    fn new_span(&self, _: &span::Attributes<'_>) -> span::Id {
        span::Id::from_u64(1)
    }
    fn record(&self, _: &span::Id, _: &span::Record<'_>) {}
    fn record_follows_from(&self, _: &span::Id, _: &span::Id) {}
    fn enter(&self, _: &span::Id) {}
    fn exit(&self, _: &span::Id) {}
}

#[test]
fn the_event_of_the_end_of_one_that_is_removed_by_it_says_whose_life_it_was_and_what_waits() {
    let (read, events) = sync_channel(1_000);
    tracing::subscriber::set_global_default(Reader(read)).expect("it is the only one of this process");
    let (go, may) = sync_channel(1);
    let may = Arc::new(Mutex::new(may));
    let spec = AppSpec::new("mortal", move || Mortal(may.clone())).handles::<Number>();
    let stage = Stage::start(vec![spec.restart(Restart::Temporary).own_thread().into()]);
    stage.wait_ready(0);
    (1..=3).for_each(|number| stage.send(0, number));
    go.send(()).unwrap();
    let end = loop {
        let event = events.recv_timeout(DEADLINE).expect("the end is told");
        if event.contains("a child ended") {
            break event;
        }
    };
    for said in ["supervisor=\"test\"", "child=\"mortal\"", "generation=1", "restarts=0", "waiting=2"] {
        assert!(end.contains(said), "{said}: {end}");
    }
    stage.stop();
}
