//! iceoryx2: payload in shared memory, woken by its events or polled.

use iceoryx2::{
    port::{listener::Listener, notifier::Notifier, publisher::Publisher, subscriber::Subscriber},
    prelude::*,
};
use sinew_figures::{
    Figures, Pinning, Rounds,
    process::{Process, print_ready},
};

use crate::{
    path::{Path, echo_role},
    ping::DEADLINE,
};

/// Round trips.
pub(crate) fn measure(path: Path, rounds: Rounds, pinning: Pinning) -> Figures {
    let run = std::process::id().to_string();
    let mut end = End::new(&run, ["there", "back"], path, rounds.bytes);
    let _echo = Process::start(&echo_role(path, rounds.bytes, pinning, &run));
    let mut buffer = vec![7; rounds.bytes];
    rounds.time(|| {
        end.send(&buffer);
        end.receive(&mut buffer);
    })
}

/// The other end.
pub(crate) fn echo(path: Path, bytes: usize, run: &str) {
    let (mut end, mut buffer) = (End::new(run, ["back", "there"], path, bytes), vec![0; bytes]);
    print_ready();
    loop {
        end.receive(&mut buffer);
        end.send(&buffer);
    }
}

/// One end of both directions.
struct End {
    outward: Publisher<ipc::Service, [u8], ()>,
    inward: Subscriber<ipc::Service, [u8], ()>,
    /// The notifier of the peer, and the listener for its notifications; `None`: both ends poll continuously.
    bells: Option<(Notifier<ipc::Service>, Listener<ipc::Service>)>,
}

impl End {
    fn new(run: &str, [outward, inward]: [&str; 2], path: Path, bytes: usize) -> Self {
        let node = NodeBuilder::new().create::<ipc::Service>().expect("its node");
        let builder = |direction: &str| {
            let name = format!("sinew-peers-{run}-{direction}");
            node.service_builder(&name.as_str().try_into().expect("a name that it takes"))
        };
        let data =
            |direction| builder(direction).publish_subscribe::<[u8]>().open_or_create().expect("its service");
        let bells = (path == Path::Iceoryx2Event).then(|| {
            let bell = |direction| builder(direction).event().open_or_create().expect("its events");
            let notifier = bell(outward).notifier_builder().create().expect("its notifier");
            (notifier, bell(inward).listener_builder().create().expect("its listener"))
        });
        let publisher = data(outward).publisher_builder().initial_max_slice_len(bytes).create();
        let subscriber = data(inward).subscriber_builder().create();
        Self {
            outward: publisher.expect("its publisher"),
            inward: subscriber.expect("its subscriber"),
            bells,
        }
    }

    fn send(&self, payload: &[u8]) {
        let loan = self.outward.loan_slice_uninit(payload.len()).expect("memory of its own");
        loan.write_from_slice(payload).send().expect("the other end");
        if let Some((notifier, _)) = &self.bells {
            notifier.notify().expect("the other end listens");
        }
    }

    fn receive(&mut self, payload: &mut [u8]) {
        loop {
            if let Some(sample) = self.inward.receive().expect("its memory") {
                return payload.copy_from_slice(sample.payload());
            }
            match &self.bells {
                Some((_, listener)) => drop(listener.timed_wait(|_| {}, DEADLINE).expect("its events")),
                None => std::hint::spin_loop(),
            }
        }
    }
}
