//! `sinew watch`: what an application gets and sends, as it goes by.

mod rates;

use std::{
    collections::BTreeMap,
    io::Write as _,
    time::{Duration, Instant},
};

use clap::Args;
use serde_json::{Value, json};
use sinew::{
    AppAddress, Tid,
    inspect::{AppsReport, AskApps, AskWatch, SeenMessage, WatchReport},
};

use crate::{
    Said, messagepack,
    system::{Fault, System, in_words},
    table::{clean, time},
};
use rates::Rates;

/// How often it is asked: well within the lease of 3 s, and soon enough for a reader.
const PERIOD: Duration = Duration::from_millis(100);
/// How often the rates are said.
const RATES_PERIOD: Duration = Duration::from_secs(1);
/// So many without an answer, one after the other, are enough.
const IN_VAIN_MAX: u32 = 3;

/// What to watch.
#[derive(Debug, Args)]
pub(crate) struct Order {
    /// An application's TID (127.0.0.2/80000001) or name
    whom: String,
    /// Only what it gets
    #[arg(long, conflicts_with = "sent")]
    received: bool,
    /// Only what it sends
    #[arg(long)]
    sent: bool,
    /// Only this type of payload: its name, or its number. May be given several times
    #[arg(long, value_name = "KIND")]
    kind: Vec<String>,
    /// Only the rates, once a second
    #[arg(long)]
    rates: bool,
    /// End after so many messages
    #[arg(long, short, value_name = "COUNT", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    /// End after so long
    #[arg(long = "for", value_name = "SECONDS", value_parser = clap::value_parser!(u64).range(1..=86_400))]
    lasts: Option<u64>,
}

/// Shows it until the end that was asked for, or the user's.
pub(crate) fn show(system: &mut System, order: &Order, is_json: bool) -> Result<Said, Fault> {
    let app = application(system, &order.whom)?;
    let kinds = order.kind.iter().map(|kind| crate::send::kind(kind)).collect::<Result<Vec<_>, _>>()?;
    let screen = Screen { names: names(system)?, is_json, rates_only: order.rates };
    let mut question = AskWatch { app, received: !order.sent, sent: !order.received };
    let began = Instant::now();
    let ends = order.lasts.map(|seconds| began + Duration::from_secs(seconds));
    let (mut rates, mut rates_due) = (Rates::default(), began + RATES_PERIOD);
    let (mut shown, mut in_vain) = (0, 0);
    let mut is_over = false;
    screen.heading(&order.whom, app);
    while !is_over {
        match ask(system, &question) {
            Ok(report) => {
                in_vain = 0;
                rates.drop(report.dropped);
                let chosen = report.seen.iter().filter(|m| kinds.is_empty() || kinds.contains(&m.kind));
                let left = order.count.map_or(u64::MAX, |count| count - shown);
                for message in chosen.take(usize::try_from(left).unwrap_or(usize::MAX)) {
                    shown += 1;
                    rates.add(message);
                    is_over |= !screen.message(began, message);
                }
                is_over |= order.count == Some(shown);
                if !report.more && !is_over {
                    std::thread::sleep(PERIOD);
                }
            }
            Err(why) if in_vain + 1 == IN_VAIN_MAX => return Err(Fault::NoAnswer(system.path.clone(), why)),
            Err(_) => {
                in_vain += 1;
                std::thread::sleep(PERIOD);
            }
        }
        let now = Instant::now();
        is_over |= ends.is_some_and(|ends| now >= ends);
        if now >= rates_due || is_over {
            is_over |= !screen.rates(&rates.end(now.duration_since(rates_due - RATES_PERIOD)));
            rates_due = now + RATES_PERIOD;
            follow(system, &order.whom, &mut question);
        }
    }
    // All was said as it came.
    Ok(Said { text: String::new(), json: Value::Null, is_fine: true })
}

fn application(system: &mut System, whom: &str) -> Result<Tid, Fault> {
    let app = system.find(whom)?;
    if app.app == AppAddress::INSPECT && is_name(whom) {
        let whom = clean(whom);
        return Err(Fault::Whom(format!(
            "'{whom}' is a node; `sinew apps` shows the applications that it has"
        )));
    }
    Ok(app)
}

/// A name is followed to where it is now: its application may have been started again elsewhere. One that is gone keeps its address until
/// the name has another.
fn follow(system: &mut System, whom: &str, question: &mut AskWatch) {
    if is_name(whom)
        && let Ok(Some(tid)) = system.endpoint.resolve(whom, system.within)
        && tid != question.app
    {
        question.app = tid;
        eprintln!("{} is {tid} now", clean(whom));
    }
}

/// A name may have a slash in it, as a TID has.
fn is_name(whom: &str) -> bool {
    whom.parse::<Tid>().is_err()
}

fn ask(system: &mut System, question: &AskWatch) -> Result<WatchReport, String> {
    let to = Tid::new(question.app.node, AppAddress::INSPECT);
    let report: WatchReport =
        system.endpoint.ask(to, question, system.within).map_err(|error| in_words(&error))?;
    report.refused.clone().map_or(Ok(report), Err)
}

/// What the applications are called that are there now.
fn names(system: &mut System) -> Result<BTreeMap<Tid, String>, Fault> {
    let here = system.here()?;
    let answers = system.ask_all::<AskApps, AppsReport>(&here);
    let apps = answers.into_iter().filter_map(|answer| answer.said.ok()).flat_map(|said| said.apps);
    Ok(apps.filter_map(|app| Some((app.tid, app.name?))).collect())
}

/// Where it is shown. Each method says whether there is still a reader.
struct Screen {
    names: BTreeMap<Tid, String>,
    is_json: bool,
    rates_only: bool,
}

impl Screen {
    fn heading(&self, whom: &str, app: Tid) {
        if !self.is_json {
            let whom = clean(whom);
            eprintln!(
                "{whom} ({app}): what it gets (->) and sends (<-); Ctrl-C ends it. Not seen: direct links between processes"
            );
        }
    }

    fn message(&self, began: Instant, message: &SeenMessage) -> bool {
        if self.rates_only {
            return true;
        }
        if self.is_json {
            return say(&self.message_json(message).to_string());
        }
        let seen = began.elapsed().saturating_sub(Duration::from_micros(message.seen_us));
        let (arrow, other) = if message.is_sent { ("<-", message.target) } else { ("->", message.source) };
        let wants = message.wants.as_ref().map_or_else(String::new, |wants| format!(" {wants}"));
        let refused =
            message.refused.map_or_else(String::new, |refused| format!("  REFUSED {refused:?}: {refused}"));
        let line = format!(
            "{:>9.3} {arrow} {:<20} {:<15} {:<20} {:>9}  {}{refused}",
            seen.as_secs_f64(),
            kind(message),
            format!("{:?}{wants}", message.class),
            self.names.get(&other).cloned().unwrap_or_else(|| other.to_string()),
            age(message),
            payload(message),
        );
        say(&clean(&line))
    }

    fn message_json(&self, message: &SeenMessage) -> Value {
        json!({
            "event": "message", "sent": message.is_sent, "kind": kind(message), "kind_id": message.kind.to_string(),
            "class": format!("{:?}", message.class).to_lowercase(), "wants": message.wants,
            "source": message.source.to_string(), "source_name": self.names.get(&message.source),
            "target": message.target.to_string(), "target_name": self.names.get(&message.target),
            "sequence": message.sequence, "age_ns": message.age_error_ns.map(|_| message.age_ns), "age_error_ns": message.age_error_ns, "bytes": message.length,
            "refused": message.refused.map(|refused| format!("{refused:?}")),
            "payload": is_whole(message).then(|| messagepack::shown_or_raw(&message.payload)),
        })
    }

    fn rates(&self, rates: &rates::Rated) -> bool {
        if self.is_json { say(&rates.json().to_string()) } else { say(&clean_lines(&rates.text())) }
    }
}

fn kind(message: &SeenMessage) -> String {
    message.name.clone().unwrap_or_else(|| message.kind.to_string())
}

/// How old a message was; nothing is said of what came from a node whose clock nobody has measured.
fn age(message: &SeenMessage) -> String {
    message.age_error_ns.map_or_else(|| "?".to_owned(), |_| time(message.age_ns / 1_000))
}

const fn is_whole(message: &SeenMessage) -> bool {
    message.payload.len() as u64 == message.length
}

fn payload(message: &SeenMessage) -> String {
    if is_whole(message) {
        messagepack::shown_or_raw(&message.payload).to_string()
    } else {
        format!("({} bytes, too long to be shown)", message.length)
    }
}

fn clean_lines(text: &str) -> String {
    text.lines().map(clean).collect::<Vec<_>>().join("\n")
}

/// Whether somebody still reads it.
fn say(line: &str) -> bool {
    writeln!(std::io::stdout(), "{line}").is_ok()
}
