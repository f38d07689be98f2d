//! An application that is slower than its senders on another node: it slows these down, and no others.

use std::{
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    time::Duration,
};

use sinew::{
    message::{Rejection, SendError},
    prelude::*,
};
use sinew_testkit::{DEADLINE, Loopback};

payload!("slow.job", Bulk => struct Job { number: u64 });
payload!("slow.question", Bulk => struct Question { number: u64 });
payload!("slow.answer", Bulk => struct Answer { number: u64 });

/// Jobs that are sent to the slow application.
const JOBS: u64 = 1_500;
/// Its handling time for each.
const PAUSE: Duration = Duration::from_millis(1);
/// Capacity of each queue of these nodes: far less than the number of jobs.
const QUEUE: usize = 64;

/// Handles slowly, and reports each job.
struct Slow(SyncSender<u64>);

impl Actor for Slow {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Job>> for Slow {
    type Result = ();

    fn handle(&mut self, job: Delivery<Job>, _: &mut Self::Context) {
        std::thread::sleep(PAUSE);
        self.0.send(job.number).expect("the test listens");
    }
}

struct Quick;

impl Actor for Quick {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Question>> for Quick {
    type Result = ();

    fn handle(&mut self, question: Delivery<Question>, context: &mut Self::Context) {
        context.reply(&question, &Answer { number: question.number }).expect("the requester waits");
    }
}

/// The sender's record.
#[derive(Debug)]
struct Seen {
    refused: u64,
    answered: u64,
}

/// Sends jobs as fast as they are accepted, and sends requests to the quick application in between.
struct Sending(SyncSender<Seen>);

impl Actor for Sending {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let (sender, done) = (context.sender(), self.0.clone());
        let work = async move {
            let mut seen = Seen { refused: 0, answered: 0 };
            for number in 0..JOBS {
                while let Err(error) = sender.send("slow", &Job { number }) {
                    assert!(matches!(error, SendError::Rejected(Rejection::QueueFull)), "{error}");
                    seen.refused += 1;
                    // The path is full now and then: the request is repeated until there is room.
                    let ask = sender.message("quick", &Question { number }).ask::<Answer>(DEADLINE);
                    let answer = ask.expect("what is for others is taken").await.expect("and answered");
                    assert_eq!(answer.number, number);
                    seen.answered += 1;
                }
            }
            done.send(seen).expect("the test waits");
        };
        context.spawn(work.into_actor(self));
    }
}

fn node(loopback: &Loopback, name: &str) -> NodeBuilder {
    loopback.node(name).configure(|config| {
        config.mailbox_capacity = QUEUE;
        config.gncl.queue_capacity = QUEUE;
    })
}

fn in_order(done: &Receiver<u64>) {
    for number in 0..JOBS {
        assert_eq!(done.recv_timeout(DEADLINE).expect("each job is done"), number);
    }
}

#[test]
fn slow_app_keeps_order_and_delays_no_neighbour() {
    let loopback = Loopback::new();
    let (home, there) = (node(&loopback, "home"), node(&loopback, "there"));
    let (reports, done) = sync_channel(JOBS as usize);
    let (results, seen) = sync_channel(1);
    let slow = AppSpec::new("slow", move || Slow(reports.clone())).handles::<Job>().own_thread();
    let quick = AppSpec::new("quick", || Quick).handles::<Question>().own_thread();
    let _there = there.app(slow).app(quick).start().expect("a node");
    let sending = AppSpec::new("sending", move || Sending(results.clone())).requires(["slow", "quick"]);
    let here = home.app(sending).start().expect("a node");
    in_order(&done);
    let seen = seen.recv_timeout(DEADLINE).expect("all were sent");
    assert!(seen.refused > 0 && seen.answered == seen.refused, "{seen:?}");
    let traffic = here.handle().traffic();
    assert!(traffic.iter().all(|peer| peer.counts.lost == 0 && peer.waiting == 0), "{traffic:?}");
}
