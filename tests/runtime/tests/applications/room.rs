//! Applications that send when there is room.

use std::sync::mpsc::{SyncSender, sync_channel};

use actix::{Actor, AsyncContext, Handler, fut::WrapFuture};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    tid::Tid,
};

use sinew_runtime_tests::{DEADLINE, Number, Stage, tid};

/// Numbers of each flood: many times the capacity of a mailbox.
const COUNT: u64 = 5_000;

/// Records its messages with their sources.
struct Sink(SyncSender<(Tid, u64)>);

impl Actor for Sink {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Number>> for Sink {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, _: &mut Self::Context) {
        self.0.send((number.source, number.payload.0)).expect("the test reads");
    }
}

/// Sends rising numbers, each as soon as there is room.
struct Flooder(Tid);

impl Actor for Flooder {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let (sender, to) = (context.sender(), self.0);
        let flood = async move {
            for number in 0..COUNT {
                let sent = sender.message(to, &Number(number)).room_within(DEADLINE).send();
                sent.await.expect("the sink takes numbers");
            }
        };
        context.spawn(flood.into_actor(self));
    }
}

#[test]
fn floods_of_two_senders_arrive_whole_and_in_order() {
    let (written, read) = sync_channel(2 * COUNT as usize);
    let sink = AppSpec::new("sink", move || Sink(written.clone())).handles::<Number>().own_thread();
    let flooder = |name: &str| AppSpec::new(name, || Flooder(tid(0))).own_thread();
    let stage = Stage::start(vec![sink.into(), flooder("one").into(), flooder("other").into()]);
    let mut next = [0; 3];
    for _ in 0..2 * COUNT {
        let (source, number) = read.recv_timeout(DEADLINE).expect("a number");
        let from = (1..3).find(|index| tid(*index) == source).expect("a flooder");
        assert_eq!(number, next[from]);
        next[from] += 1;
    }
    assert_eq!(next, [0, COUNT, COUNT]);
    assert_eq!(stage.router.refused(), 0, "a message that waits for room is not refused");
    stage.stop();
}
