//! The node to which things happen.

use std::{process::ExitCode, thread, time::Duration};

use sinew::prelude::*;
use sinew_figures::process::{await_end, print_ready};

use crate::{nodes::At, observer::DEADLINE, setting::Setting, way::Ports};

/// Name of the node, and of its application.
pub(crate) const SUBJECT: &str = "subject";

payload!("detection.hold" =>
    /// Requests a turn that lasts this long.
    pub(crate) struct Hold {
        /// Whether it keeps its CPU; else it sleeps.
        pub(crate) spins: bool,
        /// How long, in microseconds.
        pub(crate) for_us: u64,
    }
);

payload!("detection.held" =>
    /// Is sent at the beginning of that turn.
    pub(crate) struct Held {
        /// Start of the turn, in nanoseconds of the clock that all namespaces share.
        pub(crate) since_ns: u64,
    }
);

struct Subject;

impl Actor for Subject {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Hold>> for Subject {
    type Result = ();

    fn handle(&mut self, hold: Delivery<Hold>, context: &mut Self::Context) {
        let since = Time::now();
        context.send(hold.source, &Held { since_ns: since.as_nanos() }).expect("the observer takes it");
        let lasts = Duration::from_micros(hold.payload.for_us);
        if hold.payload.spins {
            while Time::now().since(since) < lasts {
                std::hint::spin_loop();
            }
        } else {
            thread::sleep(lasts);
        }
    }
}

/// Runs the node until a signal stops it, or the process that started it ends.
pub(crate) fn run(ports: Ports, setting: Setting, at: At) -> ExitCode {
    let app = AppSpec::new(SUBJECT, || Subject).handles::<Hold>().own_thread().progress_within(DEADLINE);
    let node = at.node(SUBJECT).app(app).heed_signals().configure(|config| {
        setting.write_to(config);
        if ports == Ports::Same {
            // Below those that the system gives to others.
            (config.gncl.port, config.ndl.port) = (at.port() / 2, at.port() / 2);
        }
    });
    let began = Time::now();
    let node = node.start().expect("a node");
    print_ready();
    println!("{}", began.as_nanos());
    thread::spawn(|| {
        await_end();
        std::process::exit(0);
    });
    node.run()
}
