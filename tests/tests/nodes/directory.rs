//! The directory of names, as a subscribed application sees it.

use std::sync::mpsc::{SyncSender, sync_channel};

use sinew::{events::DirectoryEvent, prelude::*};
use sinew_testkit::{DEADLINE, Loopback};

payload!("scenario.angle" => struct Angle { degrees: f32 });

struct Knee;

impl Actor for Knee {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Angle>> for Knee {
    type Result = ();

    fn handle(&mut self, angle: Delivery<Angle>, _: &mut Self::Context) {
        assert!(angle.degrees < 360.0);
    }
}

struct Watcher(SyncSender<DirectoryEvent>);

impl Actor for Watcher {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<DirectoryEvent>> for Watcher {
    type Result = ();

    fn handle(&mut self, event: Delivery<DirectoryEvent>, _: &mut Self::Context) {
        self.0.send(event.payload).expect("the test listens");
    }
}

#[test]
fn watcher_is_notified_of_remote_start_and_end() {
    let loopback = Loopback::new();
    let (events, received) = sync_channel(64);
    let watcher = AppSpec::new("watcher", move || Watcher(events.clone())).handles::<DirectoryEvent>();
    let _hip = loopback.node("hip").app(watcher).start().expect("it starts");
    let knee = loopback
        .node("knee")
        .app(AppSpec::new("knee", || Knee).handles::<Angle>())
        .start()
        .expect("it starts");
    let wait_for = |what: &str, is_it: &dyn Fn(&DirectoryEvent) -> bool| loop {
        let event =
            received.recv_timeout(DEADLINE).unwrap_or_else(|_| panic!("it is not notified that {what}"));
        if is_it(&event) {
            break;
        }
    };
    wait_for(
        "the knee is ready",
        &|event| matches!(event, DirectoryEvent::Is(entry) if entry.name == "knee" && entry.ready && entry.kinds.contains(&Angle::KIND)),
    );
    drop(knee);
    wait_for(
        "the knee is gone",
        &|event| matches!(event, DirectoryEvent::Gone { name, .. } if name == "knee"),
    );
}
