//! The same actor on the wall clock: under a supervisor, as in a node.

use std::sync::mpsc::{SyncSender, sync_channel};

use sinew_runtime_tests::{DEADLINE, Stage};

use super::*;

/// Passes the time of `ctx.now()` at its third turn, and since when it runs.
struct Turns {
    began: Option<Time>,
    seen: SyncSender<(Duration, Time)>,
}

impl Actor for Turns {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        self.began = Some(ctx.now());
        ctx.run_later(Duration::from_millis(2), |_, _| {});
        ctx.every(Duration::from_millis(5), |this, tick, ctx| {
            if tick.number == 3 {
                let ran = ctx.now().since(this.began.unwrap());
                let _ = this.seen.try_send((ran, ctx.sender().now()));
            }
        });
    }
}

fn turns() -> (AppSpec<Turns>, std::sync::mpsc::Receiver<(Duration, Time)>) {
    let (seen, turns) = sync_channel(4);
    (AppSpec::new("hip", move || Turns { began: None, seen: seen.clone() }), turns)
}

#[test]
fn same_actor_runs_in_wall_time_and_virtual_time() {
    let (spec, seen) = turns();
    replay().app(spec).ends_at(ms(20)).run([]).unwrap();
    assert_eq!(seen.recv_timeout(DEADLINE).unwrap(), (Duration::from_millis(15), ms(15)));
    let (spec, seen) = turns();
    let before = Time::now();
    let _stage = Stage::start(vec![spec.into()]);
    let (ran, now) = seen.recv_timeout(DEADLINE).unwrap();
    assert!(ran >= Duration::from_millis(15) && now >= before + ran && now <= Time::now());
}
