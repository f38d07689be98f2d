//! `sinew watch`: what an application gets and sends, as it goes by.

mod envelope;
mod rates;

use std::{
    collections::BTreeMap,
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use clap::Args;
use serde_json::{Value, json};
use sinew::{
    AppAddress, NodeAddress, Tid,
    client::ApiError,
    inspect::{AppsReport, AskApps, AskWatch, SeenMessage, WatchReport},
};

use crate::{
    Report, messagepack, output,
    system::{Answer, Fault, System, in_words},
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
    /// An application's TID (127.0.0.2/80000001) or name, or a group's name: then what its members get by it
    target: String,
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
pub(crate) fn show(system: &mut System, order: &Order, is_json: bool) -> Result<Report, Fault> {
    let app = application(system, &order.target)?;
    let kinds = order.kind.iter().map(|kind| crate::send::kind(kind)).collect::<Result<Vec<_>, _>>()?;
    let screen = Screen { names: Names::asked(system)?, is_json, rates_only: order.rates };
    let mut watched = Watched::new(system, order, app)?;
    let began = Instant::now();
    let ends = order.lasts.map(|seconds| began + Duration::from_secs(seconds));
    let mut rates = Rates::default();
    // The first answers begin the watch: what was there before is no part of a rate.
    let (mut rates_began, mut rates_due, mut fetched) = (None, began + RATES_PERIOD, began);
    let (mut shown, mut is_over) = (0, false);
    screen.heading(&order.target, app);
    while !is_over {
        let report = watched.ask(system, &screen)?;
        fetched = report.as_ref().map_or(fetched, |_| Instant::now());
        let report = report.unwrap_or_default();
        if rates_began.is_none() && fetched > began {
            (rates_began, rates_due) = (Some(fetched), fetched + RATES_PERIOD);
        }
        rates.drop(report.dropped);
        let is_chosen = |m: &&SeenMessage| watched.shows(m) && (kinds.is_empty() || kinds.contains(&m.kind));
        let left = order.count.map_or(u64::MAX, |count| count - shown);
        // The rate is of all messages up to the last answer, also of those beyond the count.
        report.seen.iter().filter(is_chosen).for_each(|message| rates.add(message));
        for message in report.seen.iter().filter(is_chosen).take(usize::try_from(left).unwrap_or(usize::MAX))
        {
            shown += 1;
            is_over |= !screen.message(began, message);
        }
        is_over |= order.count == Some(shown);
        if !report.more && !is_over {
            std::thread::sleep(PERIOD);
        }
        let now = Instant::now();
        is_over |= ends.is_some_and(|ends| now >= ends);
        if now >= rates_due || is_over {
            // Up to the last answer: what came since then is in the next one.
            let over = fetched.saturating_duration_since(rates_began.unwrap_or(began));
            is_over |= !screen.rates(&rates.end(over));
            (rates_began, rates_due) = (rates_began.map(|_| fetched), now + RATES_PERIOD);
            watched.follow(system);
        }
    }
    // All was said as it came.
    Ok(Report { text: String::new(), json: Value::Null, is_fine: true })
}

/// Members of a group that are watched at most: a node shows 8 watches at once.
const MEMBERS_MAX: usize = 8;

/// One application, or the members of a group.
struct Watched {
    target: String,
    /// The group, if it is one.
    group: Option<Tid>,
    questions: Vec<AskWatch>,
    received: bool,
    sent: bool,
    /// Rounds without any answer, one after the other.
    in_vain: u32,
}

impl Watched {
    fn new(system: &mut System, order: &Order, app: Tid) -> Result<Self, Fault> {
        let mut watched = Self {
            target: order.target.clone(),
            group: Some(app).filter(|app| !app.is_single()),
            questions: Vec::new(),
            received: !order.sent,
            // Nothing is sent by a group.
            sent: !order.received && app.is_single(),
            in_vain: 0,
        };
        match watched.group {
            None => watched.questions.push(watched.question(app)),
            Some(group) => {
                watched.take_members(system.members(group)?.0);
                if watched.questions.is_empty() {
                    let target = clean(&order.target);
                    output::note(format_args!(
                        "'{target}' has no members yet; no application and no node has this name either"
                    ));
                }
            }
        }
        Ok(watched)
    }

    const fn question(&self, app: Tid) -> AskWatch {
        AskWatch { app, received: self.received, sent: self.sent }
    }

    fn take_members(&mut self, members: Vec<Tid>) {
        let left_out = members.len().saturating_sub(MEMBERS_MAX);
        if left_out > 0 && self.questions.is_empty() {
            output::note(format_args!(
                "{left_out} further members are not watched: at most {MEMBERS_MAX} are"
            ));
        }
        self.questions = members.into_iter().take(MEMBERS_MAX).map(|member| self.question(member)).collect();
    }

    /// Whether a message of one of them is shown: of members of a group those that were sent to the group.
    fn shows(&self, message: &SeenMessage) -> bool {
        self.group.is_none_or(|group| message.target.app == group.app)
    }

    /// What was seen since the last question; `None` where nobody has answered.
    ///
    /// # Errors
    /// Nobody has answered several times in a row.
    fn ask(&mut self, system: &mut System, screen: &Screen) -> Result<Option<WatchReport>, Fault> {
        let mut all: Option<WatchReport> = self.questions.is_empty().then(WatchReport::default);
        let mut failed = None;
        for question in &self.questions {
            match ask(system, question) {
                Ok(report) => {
                    let all = all.get_or_insert_with(WatchReport::default);
                    all.seen.extend(report.seen);
                    (all.dropped, all.more) = (all.dropped + report.dropped, all.more | report.more);
                }
                Err(vain) => failed = Some((question.app.node, vain)),
            }
        }
        self.in_vain = if all.is_some() { 0 } else { self.in_vain + 1 };
        if let Some((node, vain)) = failed.filter(|_| self.in_vain == IN_VAIN_MAX) {
            let here = (system.endpoint.tid().node, system.path.as_str());
            return Err(vain.blamed(here, node, &screen.names));
        }
        Ok(all)
    }

    /// A name is followed to where it is now: its application may have been started again elsewhere. One that is gone keeps its address until
    /// the name has another. A group has the members that it has now.
    fn follow(&mut self, system: &mut System) {
        if let Some(group) = self.group {
            if let Ok((members, _)) = system.members(group) {
                self.take_members(members);
            }
            return;
        }
        if is_name(&self.target)
            && let Ok(Some(tid)) = system.endpoint.resolve(&self.target, system.within)
            && let Some(question) = self.questions.first_mut()
            && tid != question.app
        {
            question.app = tid;
            output::note(format_args!("{} is {tid} now", clean(&self.target)));
        }
    }
}

fn application(system: &mut System, whom: &str) -> Result<Tid, Fault> {
    let app = system.find_or_group(whom)?;
    if app.app == AppAddress::INSPECT && is_name(whom) {
        let whom = clean(whom);
        return Err(Fault::Whom(format!(
            "'{whom}' is a node; `sinew apps` shows the applications that it has"
        )));
    }
    Ok(app)
}

/// A name may have a slash in it, as a TID has.
fn is_name(whom: &str) -> bool {
    whom.parse::<Tid>().is_err()
}

fn ask(system: &mut System, question: &AskWatch) -> Result<WatchReport, Vain> {
    let to = Tid::new(question.app.node, AppAddress::INSPECT);
    let report: WatchReport =
        system.endpoint.message(to, question).ask(system.within).map_err(|error| Vain::of(&error))?;
    report.refused.clone().map_or(Ok(report), |why| Err(Vain::Refused(why)))
}

/// Why a question brought nothing.
#[derive(Debug)]
enum Vain {
    /// It did not get out of this program, or not to the node through which we came.
    NotAsked(String),
    /// The application's node did not answer it, or cannot.
    NotAnswered(String),
    /// The application's node shows nothing, in its own words.
    Refused(String),
}

impl Vain {
    fn of(error: &ApiError) -> Self {
        let why = in_words(error);
        let is_of_the_other =
            matches!(error, ApiError::Ended(_) | ApiError::NoReply(_) | ApiError::Malformed(_));
        if is_of_the_other { Self::NotAnswered(why) } else { Self::NotAsked(why) }
    }

    /// Whose fault it is: that of the node `here`, through whose socket we came, only where it gives no answer itself.
    fn blamed(self, here: (NodeAddress, &str), there: NodeAddress, names: &Names) -> Fault {
        let (here, path) = here;
        match self {
            Self::NotAsked(why) => Fault::NoAnswer(path.to_owned(), why),
            Self::NotAnswered(why) if here == there => Fault::NoAnswer(path.to_owned(), why),
            Self::NotAnswered(why) | Self::Refused(why) => Fault::ItsNode(names.of_node(there), clean(&why)),
        }
    }
}

/// What those are called that are there now.
#[derive(Default)]
struct Names {
    apps: BTreeMap<Tid, String>,
    nodes: BTreeMap<NodeAddress, String>,
}

impl Names {
    fn asked(system: &mut System) -> Result<Self, Fault> {
        let here = system.here()?;
        Ok(Self::of(system.ask_all::<AskApps, AppsReport>(&here)))
    }

    fn of(answers: Vec<Answer<AppsReport>>) -> Self {
        let mut names = Self::default();
        for Answer { node, name, said } in answers {
            // One that is lost has none for the others any more.
            if !name.is_empty() {
                names.nodes.insert(node, name);
            }
            let apps = said.into_iter().flat_map(|said| said.apps);
            names.apps.extend(apps.filter_map(|app| Some((app.tid, app.name?))));
        }
        names
    }

    /// The node as it is called in what is said.
    fn of_node(&self, node: NodeAddress) -> String {
        let name = self.nodes.get(&node);
        name.map_or_else(|| node.to_string(), |name| format!("{} at {node}", clean(name)))
    }
}

/// Where it is shown. Each method says whether there is still a reader.
struct Screen {
    names: Names,
    is_json: bool,
    rates_only: bool,
}

impl Screen {
    fn heading(&self, whom: &str, app: Tid) {
        if !self.is_json {
            let whom = clean(whom);
            output::note(format_args!(
                "{whom} ({app}): what it gets (->) and sends (<-); Ctrl-C ends it. Not seen: direct links between processes"
            ));
        }
    }

    fn message(&self, began: Instant, message: &SeenMessage) -> bool {
        if self.rates_only {
            return true;
        }
        if self.is_json {
            return output::line(&self.message_json(message).to_string());
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
            self.names.apps.get(&other).cloned().unwrap_or_else(|| other.to_string()),
            age(message),
            payload(message),
        );
        output::line(&clean(&line))
    }

    fn message_json(&self, message: &SeenMessage) -> Value {
        let (counter, payload) = if is_whole(message) { value(&message.payload) } else { Default::default() };
        json!({
            "event": "message", "time_s": since_1970(Duration::from_micros(message.seen_us)), "sent": message.is_sent, "kind": kind(message), "kind_id": message.kind.to_string(),
            "class": format!("{:?}", message.class).to_lowercase(), "wants": message.wants,
            "source": message.source.to_string(), "source_name": self.names.apps.get(&message.source),
            "target": message.target.to_string(), "target_name": self.names.apps.get(&message.target),
            "sequence": message.sequence, "age_ns": message.age_ns, "age_error_ns": message.age_error_ns, "bytes": message.length,
            "refused": message.refused.map(|refused| format!("{refused:?}")),
            "protected": counter.map(|counter| json!({ "counter": counter })),
            "payload": payload,
        })
    }

    fn rates(&self, rates: &rates::Rated) -> bool {
        if self.is_json {
            output::line(&rates.json(since_1970(Duration::ZERO)).to_string())
        } else {
            output::line(&clean_lines(&rates.text()))
        }
    }
}

/// Seconds since 1970, by the clock of this host, of what was seen so long ago.
#[expect(clippy::disallowed_methods, reason = "people compare the time of a line with a clock on the wall")]
fn since_1970(ago: Duration) -> f64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    now.saturating_sub(ago).as_secs_f64()
}

fn kind(message: &SeenMessage) -> String {
    message.name.clone().unwrap_or_else(|| message.kind.to_string())
}

/// How old a message was; nothing is said of what came from a node whose clock nobody has measured.
fn age(message: &SeenMessage) -> String {
    message.age_ns.map_or_else(|| "?".to_owned(), |age_ns| time(age_ns / 1_000))
}

const fn is_whole(message: &SeenMessage) -> bool {
    message.payload.len() as u64 == message.length
}

fn payload(message: &SeenMessage) -> String {
    if !is_whole(message) {
        return format!("({} bytes, too long to be shown)", message.length);
    }
    match value(&message.payload) {
        (Some(counter), value) => format!("protected #{counter} {value}"),
        (None, value) => value.to_string(),
    }
}

/// What a payload says, and the counter of one that is protected.
fn value(payload: &[u8]) -> (Option<u64>, Value) {
    let unsealed = envelope::unsealed(payload);
    let inner = unsealed.map_or(payload, |unsealed| unsealed.payload);
    (unsealed.map(|unsealed| unsealed.counter), messagepack::shown_or_raw(inner))
}

fn clean_lines(text: &str) -> String {
    text.lines().map(clean).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use sinew::{
        Class, Outcome, Time,
        message::{Kind, Rejection},
        protection::{DataId, Stamp, seal},
    };

    use super::*;
    use crate::{EXIT_FINDING, EXIT_NO_NODE};

    const HIP: NodeAddress = NodeAddress::new(0x0a00_0001);
    const KNEE: NodeAddress = NodeAddress::new(0x0a00_0002);

    /// What is said, and the exit code, where the command came in at the hip.
    fn blamed(vain: Vain, there: NodeAddress, names: &Names) -> (String, u8) {
        let fault = vain.blamed((HIP, "/run/hip.sock"), there, names);
        (fault.to_string(), fault.code())
    }

    /// The knee has said nothing of its applications.
    fn names() -> Names {
        let said = Err("no answer".to_owned());
        Names::of(vec![Answer { node: KNEE, name: "knee".to_owned(), said }])
    }

    #[test]
    fn the_node_is_blamed_that_has_the_application_and_not_the_one_through_which_we_came() {
        for error in [
            ApiError::NoReply(Duration::from_secs(2)),
            ApiError::Ended(Outcome::Rejected(Rejection::NoSuchNode)),
        ] {
            let (said, code) = blamed(Vain::of(&error), KNEE, &names());
            assert_eq!(said, format!("the application's node knee at 10.0.0.2: {}", in_words(&error)));
            assert_eq!(code, EXIT_FINDING);
        }
        let refused = || Vain::Refused("this node shows 8 watches at once".to_owned());
        let words = "the application's node knee at 10.0.0.2: this node shows 8 watches at once";
        assert_eq!(blamed(refused(), KNEE, &names()), (words.to_owned(), EXIT_FINDING));
        // One that answers is no node that does not, wherever it is.
        let words = "the application's node 10.0.0.1: this node shows 8 watches at once";
        assert_eq!(blamed(refused(), HIP, &names()), (words.to_owned(), EXIT_FINDING));
    }

    #[test]
    fn the_node_through_which_we_came_is_blamed_where_it_gives_no_answer_itself() {
        let silent = ApiError::NoReply(Duration::from_secs(2));
        let ended = ApiError::Closed("it was closed".to_owned());
        for (error, there) in [(silent, HIP), (ended, KNEE)] {
            let (said, code) = blamed(Vain::of(&error), there, &names());
            assert_eq!(
                (said, code),
                (format!("the node at /run/hip.sock: {}", in_words(&error)), EXIT_NO_NODE)
            );
        }
    }

    /// A message of the hip to the knee with this payload.
    fn seen(payload: Vec<u8>) -> SeenMessage {
        let tid = |node| Tid::new(node, AppAddress::new(0x1001));
        SeenMessage {
            seen_us: 0,
            age_ns: Some(1_000),
            age_error_ns: Some(0),
            is_sent: true,
            source: tid(HIP),
            target: tid(KNEE),
            kind: Kind::named("demo.angle"),
            name: Some("demo.angle".to_owned()),
            class: Class::Stream,
            sequence: 9,
            wants: None,
            length: payload.len() as u64,
            payload,
            refused: None,
        }
    }

    /// In an envelope, as the hip's message 103 of this type.
    fn sealed(payload: &[u8]) -> Vec<u8> {
        let SeenMessage { source, target, .. } = seen(Vec::new());
        let data_id = DataId { source, destination: target, name: "demo.angle" };
        let stamp = Stamp { counter: 103, incarnation: 7, echo: Time::ZERO };
        seal(&data_id, stamp, payload).to_vec()
    }

    fn screen() -> Screen {
        Screen { names: Names::default(), is_json: true, rates_only: false }
    }

    #[test]
    fn a_protected_payload_is_decoded_and_shown_as_such_with_its_counter() {
        let angle = json!({ "degrees": 1.5 });
        let message = seen(sealed(&messagepack::written(&angle).unwrap()));
        // For people
        assert_eq!(payload(&message), r#"protected #103 {"degrees":1.5}"#);
        // For programs: its counter is not the number that its source gave the message
        let said = screen().message_json(&message);
        assert_eq!((&said["protected"], &said["payload"]), (&json!({ "counter": 103 }), &angle));
        assert_eq!(said["sequence"], 9);
        // And: of what is in it and no MessagePack, as between programs in C, its bytes
        assert_eq!(payload(&seen(sealed(&[1, 2]))), r#"protected #103 {"bytes":"0102"}"#);
    }

    #[test]
    fn a_payload_without_an_envelope_is_shown_as_it_is_and_is_not_called_protected() {
        let angle = json!({ "degrees": 1.5 });
        let message = seen(messagepack::written(&angle).unwrap());
        assert_eq!(payload(&message), r#"{"degrees":1.5}"#);
        let said = screen().message_json(&message);
        assert_eq!((&said["protected"], &said["payload"]), (&Value::Null, &angle));
        // One byte is missing of this one.
        let mut cut = sealed(&[0x80]);
        cut.pop();
        assert!(payload(&seen(cut)).starts_with(r#"{"bytes":"0100000001"#));
        // And of one that was too long to be brought nothing is said.
        let long = SeenMessage { length: 1 << 20, ..seen(Vec::new()) };
        assert_eq!(screen().message_json(&long)["payload"], Value::Null);
        assert_eq!(payload(&long), "(1048576 bytes, too long to be shown)");
    }
}
