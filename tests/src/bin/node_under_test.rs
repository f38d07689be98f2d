//! A node for the scenarios: one application that sends, and says what it sees, one line each.
//!
//! `node_under_test CONFIG.toml [--requires NAME]... [--sends-to NAME] [--floods NAME]... [--will NAME]... [--incarnation NUMBER] [--logs | --logs-info]`
//!
//! Whom it floods it sends as many counts as are taken, to each the same. A will is a count of 1,000,000. The
//! incarnation is the clock's of its host, if none is given. What it logs goes to its standard error, with `--logs` warnings and with `--logs-info` more go to its output.

use std::process::ExitCode;

use sinew::prelude::*;

payload!("scenario.count", Bulk => struct Count { number: u64 });

/// Counts in each millisecond to whom it floods.
const AT_ONCE: u32 = 100;

struct Probe {
    sends_to: Option<String>,
    floods: Vec<String>,
    sent: u64,
    last: u64,
}

impl Actor for Probe {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        println!("started {}", context.tid());
        for to in self.floods.clone() {
            let mut sent = 0;
            context.every(Duration::from_millis(1), move |_, _, context| {
                for _ in 0..AT_ONCE {
                    sent += u64::from(context.send(&*to, &Count { number: sent + 1 }).is_ok());
                }
            });
        }
        let Some(to) = self.sends_to.clone() else { return };
        context.every(Duration::from_millis(20), move |this, _, context| {
            // What nobody takes while the network is cut is not counted as sent.
            if context.send(&*to, &Count { number: this.sent + 1 }).is_ok() {
                this.sent += 1;
            }
        });
    }

    fn stopping(&mut self, _: &mut Self::Context) -> Running {
        println!("stopping");
        Running::Stop
    }
}

impl Handler<Delivery<Count>> for Probe {
    type Result = ();

    fn handle(&mut self, count: Delivery<Count>, _: &mut Self::Context) {
        println!("count {} from {} after {}", count.number, count.source, self.last);
        self.last = count.number;
    }
}

impl Handler<Delivery<NodeEvent>> for Probe {
    type Result = ();

    fn handle(&mut self, event: Delivery<NodeEvent>, _: &mut Self::Context) {
        println!("event {:?}", event.payload);
    }
}

impl Handler<Delivery<RequirementEvent>> for Probe {
    type Result = ();

    fn handle(&mut self, event: Delivery<RequirementEvent>, _: &mut Self::Context) {
        println!("requirement {:?}", event.payload);
    }
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let has = |flag: &str| arguments.iter().any(|argument| argument == flag);
    if has("--logs") || has("--logs-info") {
        let level = if has("--logs-info") { tracing::Level::INFO } else { tracing::Level::WARN };
        tracing_subscriber::fmt().with_max_level(level).init();
    } else {
        tracing_subscriber::fmt()
            .with_env_filter(tracing_subscriber::EnvFilter::from_default_env())
            .with_writer(std::io::stderr)
            .init();
    }
    let after = |flag: &str| {
        let pairs = arguments.windows(2).filter(|pair| pair[0] == flag);
        pairs.map(|pair| pair[1].clone()).collect::<Vec<_>>()
    };
    let config = match NodeConfig::from_file(&arguments[0]) {
        Ok(config) => config,
        Err(faults) => {
            println!("refused {faults}");
            return ExitCode::FAILURE;
        }
    };
    let sends_to = after("--sends-to").into_iter().next();
    let floods = after("--floods");
    let name = config.name.clone();
    let make = move || Probe { sends_to: sends_to.clone(), floods: floods.clone(), sent: 0, last: 0 };
    let mut probe = AppSpec::new(name.as_str(), make)
        .handles::<Count>()
        .handles::<NodeEvent>()
        .handles::<RequirementEvent>()
        .requires(after("--requires"))
        .own_thread();
    for heir in after("--will") {
        probe = probe.last_will(heir.as_str(), &Count { number: 1_000_000 });
    }
    let mut builder = Node::builder(name).config(config).app(probe).heed_signals();
    for life in after("--incarnation") {
        let Ok(life) = life.parse() else {
            println!("refused --incarnation {life}: it is no number");
            return ExitCode::FAILURE;
        };
        builder = builder.incarnation(sinew::Incarnation(life));
    }
    match builder.start() {
        Ok(node) => {
            println!("up");
            node.run()
        }
        Err(error) => {
            println!("refused {error}");
            ExitCode::FAILURE
        }
    }
}
