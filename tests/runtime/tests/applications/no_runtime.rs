//! Futures of an application's sender on a thread of the program's own, without tokio.

use std::{
    pin::pin,
    sync::Arc,
    task::{Context, Poll, Wake, Waker},
    thread::Thread,
    time::{Duration, Instant},
};

use actix::{Actor, AsyncContext, Handler, fut::WrapFuture};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    outcome::Outcome,
    sender::AskError,
};

use sinew_runtime_tests::{DEADLINE, Number, Stage};

/// Receives numbers until 13 arrives, and then none.
struct Taker;

impl Actor for Taker {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Number>> for Taker {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, context: &mut Self::Context) {
        if number.0 == 13 {
            context.wait(std::future::pending().into_actor(self));
        }
    }
}

struct Unpark(Thread);

impl Wake for Unpark {
    fn wake(self: Arc<Self>) {
        self.0.unpark();
    }
}

/// An executor as small as can be.
fn block_on<F: Future>(future: F) -> F::Output {
    let waker = Waker::from(Arc::new(Unpark(std::thread::current())));
    let (mut future, until) = (pin!(future), Instant::now() + DEADLINE);
    loop {
        if let Poll::Ready(output) = future.as_mut().poll(&mut Context::from_waker(&waker)) {
            return output;
        }
        assert!(Instant::now() < until, "nobody wakes whoever waits");
        std::thread::park_timeout(DEADLINE);
    }
}

#[test]
fn outcomes_replies_and_deadlines_work_without_tokio() {
    // Given an application that is not restarted, and this thread.
    let spec = AppSpec::new("taker", || Taker).handles::<Number>().progress_within(DEADLINE * 10);
    let stage = Stage::start(vec![spec.own_thread().into()]);
    stage.wait_ready(0);
    let sender = &stage.senders[0];
    let confirmed = |number, within| sender.message(sender.tid(), &Number(number)).confirmed(within).unwrap();
    // When a message is handled, then its outcome is known.
    assert_eq!(block_on(confirmed(1, DEADLINE)), Outcome::Delivered);
    assert_eq!(block_on(confirmed(13, DEADLINE)), Outcome::Delivered);
    // When the next ones are not, then the wait ends at its deadline, and not before.
    let within = Duration::from_millis(50);
    for _ in 0..2 {
        let sent = Instant::now();
        assert_eq!(block_on(confirmed(2, within)), Outcome::Unknown);
        assert!(sent.elapsed() >= within);
    }
    let reply = sender.message(sender.tid(), &Number(3)).ask::<Number>(within).unwrap();
    let answer = block_on(reply);
    assert!(matches!(answer, Err(AskError::Deadline(after)) if after == within), "{answer:?}");
    // When the deadline passes before the first poll, then the wait ends at that poll: the time counts from
    // the send.
    let (confirmation, sent) = (confirmed(4, within), Instant::now());
    let reply = sender.message(sender.tid(), &Number(5)).ask::<Number>(within).unwrap();
    while sent.elapsed() <= within * 2 {
        std::thread::park_timeout(within);
    }
    let mut context = Context::from_waker(Waker::noop());
    assert_eq!(pin!(confirmation).poll(&mut context), Poll::Ready(Outcome::Unknown));
    assert!(matches!(pin!(reply).poll(&mut context), Poll::Ready(Err(AskError::Deadline(_)))));
    stage.order_stop();
}
