//! A supervisor's events about its children: the incarnation, its number, and the waiting messages.

use std::sync::{
    Arc, Mutex,
    mpsc::{Receiver, sync_channel},
};

use actix::{Actor, ActorContext, Handler};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    supervision::Restart,
};
use tracing::Metadata;

use super::{alone, reader::Reader};
use sinew_runtime_tests::{DEADLINE, Number, Stage};

const SUPERVISION: fn(&Metadata<'_>) -> bool =
    |metadata| metadata.target().starts_with("sinew_runtime::supervision");

/// Stops while it handles the first message, when the test permits it.
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
fn event_of_a_removed_child_has_incarnation_and_queue() {
    alone("events::event_of_a_removed_child_has_incarnation_and_queue", || {
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
        for said in
            ["supervisor='test'", "child='mortal'", "generation=1u64", "restarts=0u64", "waiting=2u64"]
        {
            assert!(end.contains(said), "{said}: {end}");
        }
        stage.stop();
    });
}
