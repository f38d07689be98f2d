//! An application that is slower than those who send to it from another node: it holds them back, and nobody else.

use std::{
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    time::Duration,
};

use sinew::{
    message::{Rejection, SendError},
    prelude::*,
};
use sinew_tests::{DEADLINE, own_group};

payload!("slow.job", Bulk => struct Job { number: u64 });
payload!("slow.question", Bulk => struct Question { number: u64 });
payload!("slow.answer", Bulk => struct Answer { number: u64 });

/// Jobs that the slow application is sent.
const JOBS: u64 = 1_500;
/// How long it takes for each.
const PAUSE: Duration = Duration::from_millis(1);
/// Messages that any queue of these nodes holds: far fewer than there are jobs.
const QUEUE: usize = 64;

/// Takes its time, and says what it did.
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
        context.reply(&question, &Answer { number: question.number }).expect("the asker waits");
    }
}

/// What the sender saw.
#[derive(Debug)]
struct Seen {
    refused: u64,
    answered: u64,
}

/// Sends jobs as fast as they are taken, and asks the quick one in between.
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
                    // It is full now and here: the quick one is asked until it is not.
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

fn node(name: &str, address: u8, group: std::net::SocketAddrV4) -> NodeBuilder {
    Node::builder(name).address([127, 0, 0, address]).configure(|config| {
        config.ndl.multicast = Some(group);
        config.ndl.mdns_port = None;
        config.mailbox_capacity = QUEUE;
        config.gncl.queue_capacity = QUEUE;
    })
}

fn in_order(did: &Receiver<u64>) {
    for number in 0..JOBS {
        assert_eq!(did.recv_timeout(DEADLINE).expect("each job is done"), number);
    }
}

#[test]
fn a_slow_application_gets_everything_in_order_and_those_beside_it_are_answered_meanwhile() {
    let group = own_group();
    let (say, did) = sync_channel(JOBS as usize);
    let (done, seen) = sync_channel(1);
    let slow = AppSpec::new("slow", move || Slow(say.clone())).handles::<Job>().own_thread();
    let quick = AppSpec::new("quick", || Quick).handles::<Question>().own_thread();
    let _there = node("there", 2, group).app(slow).app(quick).start().expect("a node");
    let sending = AppSpec::new("sending", move || Sending(done.clone())).requires(["slow", "quick"]);
    let here = node("home", 1, group).app(sending).start().expect("a node");
    in_order(&did);
    let seen = seen.recv_timeout(DEADLINE).expect("all were sent");
    assert!(seen.refused > 0 && seen.answered == seen.refused, "{seen:?}");
    let traffic = here.handle().traffic();
    assert!(traffic.iter().all(|peer| peer.counts.lost == 0 && peer.waiting == 0), "{traffic:?}");
}
