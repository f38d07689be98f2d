//! What a supervisor tells of its children as events: whose life it was, which one, and what waits.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

mod reader;
#[expect(dead_code, reason = "other tests and the benches need more of it")]
mod stage;

use std::sync::{
    Arc, Mutex,
    mpsc::{Receiver, sync_channel},
};

use actix::{Actor, ActorContext, Handler};
use reader::Reader;
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    supervision::Restart,
};
use stage::{DEADLINE, Number, Stage};
use tracing::Metadata;

const SUPERVISION: fn(&Metadata<'_>) -> bool =
    |metadata| metadata.target().starts_with("sinew_runtime::supervision");

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

#[test]
fn the_event_of_the_end_of_one_that_is_removed_by_it_says_whose_life_it_was_and_what_waits() {
    let (read, events) = sync_channel(1_000);
    let reader = Reader { wants: SUPERVISION, read, may_go_on: None };
    tracing::subscriber::set_global_default(reader).expect("it is the only one of this process");
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
    for said in ["supervisor='test'", "child='mortal'", "generation=1u64", "restarts=0u64", "waiting=2u64"] {
        assert!(end.contains(said), "{said}: {end}");
    }
    stage.stop();
}
