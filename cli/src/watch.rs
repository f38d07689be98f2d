//! `sinew watch`: the messages that an application receives and sends, live.

mod rates;
mod screen;

use std::time::{Duration, Instant};

use clap::Args;
use serde_json::Value;
use sinew::{
    AppAddress, NodeAddress, Tid,
    client::ApiError,
    inspect::{AskWatch, SeenMessage, WatchReport},
};

use crate::{
    Report, output,
    system::{System, SystemError, in_words},
    table::{clean, short},
    unknown::Target,
};
use rates::Rates;
use screen::{Names, Screen};

/// Poll interval: well within the lease of 3 s, and short enough for a reader.
const PERIOD: Duration = Duration::from_millis(100);
/// Interval at which the rates are shown.
const RATES_PERIOD: Duration = Duration::from_secs(1);
/// Maximum number of consecutive polls without an answer.
const UNANSWERED_MAX: u32 = 3;

/// The arguments of `sinew watch`.
#[derive(Debug, Args)]
pub(crate) struct Order {
    /// An application's TID (127.0.0.2/80000001) or name, or a group's name: then the messages that its
    /// members receive through it
    target: String,
    /// Only received messages
    #[arg(long, conflicts_with = "sent")]
    received: bool,
    /// Only sent messages
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
    /// Where nothing has the name yet, wait for an application that has it, or for members of a group of this name
    #[arg(long)]
    wait: bool,
}

/// Shows messages until the requested end, or until the user ends it.
pub(crate) fn show(
    system: &mut System,
    order: &Order,
    (is_json, is_wide): (bool, bool),
) -> Result<Report, SystemError> {
    let app = application(system, &order.target)?;
    let kinds = order.kind.iter().map(|kind| crate::send::kind(kind)).collect::<Result<Vec<_>, _>>()?;
    let screen = Screen { names: Names::asked(system)?, is_json, is_wide, rates_only: order.rates };
    let mut watched = Watched::new(system, order, app)?;
    let began = Instant::now();
    let ends = order.lasts.map(|seconds| began + Duration::from_secs(seconds));
    let mut rates = Rates::default();
    // The first answers start the watch: earlier messages do not count for a rate.
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
        // The rate covers all messages up to the last answer, also those beyond the count.
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
            // Up to the last answer: later messages are in the next rate.
            let over = fetched.saturating_duration_since(rates_began.unwrap_or(began));
            is_over |= !screen.rates(&rates.end(over));
            (rates_began, rates_due) = (rates_began.map(|_| fetched), now + RATES_PERIOD);
            watched.follow(system, order);
        }
    }
    // All messages were shown as they arrived.
    Ok(Report { text: String::new(), json: Value::Null, is_fine: true })
}

/// Maximum number of watched members of a group: a node allows 8 watches at once.
const MEMBERS_MAX: usize = 8;

/// One application, or the members of a group.
struct Watched {
    target: String,
    /// The group, if it is one.
    group: Option<Tid>,
    questions: Vec<AskWatch>,
    received: bool,
    sent: bool,
    /// Whether no application has the name yet.
    is_awaited: bool,
    /// Consecutive rounds without any answer.
    unanswered: u32,
}

impl Watched {
    fn new(system: &mut System, order: &Order, app: Tid) -> Result<Self, SystemError> {
        let mut watched = Self {
            target: order.target.clone(),
            group: Some(app).filter(|app| !app.is_single()),
            questions: Vec::new(),
            received: !order.sent,
            // A group does not send.
            sent: !order.received && app.is_single(),
            is_awaited: false,
            unanswered: 0,
        };
        let Some(group) = watched.group else {
            watched.questions.push(watched.question(app));
            return Ok(watched);
        };
        watched.take_members(system.members(group)?.0);
        if !watched.questions.is_empty() {
            return Ok(watched);
        }
        // The address of a group cannot be a name.
        if !is_name(&order.target) {
            output::note(format_args!("the group {} has no members yet", clean(&order.target)));
            return Ok(watched);
        }
        let unknown = system.unknown(&order.target, Target::OneOrGroup);
        if !order.wait {
            return Err(unknown.with_remedy("`--wait` waits for it"));
        }
        output::note(format_args!("sinew: {unknown}; waiting for it"));
        Ok(Self { is_awaited: true, ..watched })
    }

    const fn question(&self, app: Tid) -> AskWatch {
        AskWatch { app, received: self.received, sent: self.sent }
    }

    /// Records that an application has the awaited name.
    fn found(&mut self, order: &Order, app: Tid) {
        (self.is_awaited, self.group, self.sent) = (false, None, !order.received);
        self.questions = vec![self.question(app)];
        output::note(format_args!("{} is {app} now", short(&self.target)));
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

    /// Returns whether a message of one of them is shown: for members of a group, only messages to the group.
    fn shows(&self, message: &SeenMessage) -> bool {
        self.group.is_none_or(|group| message.target.app == group.app)
    }

    /// Returns the messages since the last question; `None` if there was no answer.
    ///
    /// # Errors
    /// There was no answer several times in a row.
    fn ask(&mut self, system: &mut System, screen: &Screen) -> Result<Option<WatchReport>, SystemError> {
        system.discard();
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
        self.unanswered = if all.is_some() { 0 } else { self.unanswered + 1 };
        if let Some((node, vain)) = failed.filter(|_| self.unanswered == UNANSWERED_MAX) {
            let here = (system.endpoint.tid().node, system.path.as_str());
            return Err(vain.blamed(here, node, &screen.names));
        }
        Ok(all)
    }

    /// Follows a name to its current address: its application may have been restarted elsewhere. A lost
    /// application keeps its address until the name has another. A group has its current members.
    fn follow(&mut self, system: &mut System, order: &Order) {
        if self.is_awaited
            && let Ok(Some(tid)) = system.endpoint.resolve(&self.target, system.within)
        {
            return self.found(order, tid);
        }
        if let Some(group) = self.group {
            if let Ok((members, _)) = system.members(group) {
                self.take_members(members);
                self.is_awaited &= self.questions.is_empty();
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

fn application(system: &mut System, target: &str) -> Result<Tid, SystemError> {
    let app = system.find_or_group(target)?;
    if app.app == AppAddress::INSPECT && is_name(target) {
        let target = short(target);
        return Err(SystemError::Unknown(format!(
            "`{target}` is a node; `sinew apps` lists the applications that it has"
        )));
    }
    Ok(app)
}

/// A name may contain a slash, as a TID does.
fn is_name(target: &str) -> bool {
    target.parse::<Tid>().is_err()
}

fn ask(system: &mut System, question: &AskWatch) -> Result<WatchReport, WatchError> {
    let to = Tid::new(question.app.node, AppAddress::INSPECT);
    let report: WatchReport =
        system.endpoint.message(to, question).ask(system.within).map_err(|error| WatchError::of(&error))?;
    report.refused.clone().map_or(Ok(report), |why| Err(WatchError::Refused(why)))
}

/// Why a question had no result.
#[derive(Debug)]
enum WatchError {
    /// It did not leave this program, or did not reach the entry node.
    NotAsked(String),
    /// The application's node did not answer it, or cannot.
    NotAnswered(String),
    /// The application's node refuses the watch, with this reason.
    Refused(String),
}

impl WatchError {
    fn of(error: &ApiError) -> Self {
        let why = in_words(error);
        let is_of_the_other =
            matches!(error, ApiError::Ended(_) | ApiError::NoReply(_) | ApiError::Malformed(_));
        if is_of_the_other { Self::NotAnswered(why) } else { Self::NotAsked(why) }
    }

    /// Returns the fault of the responsible node: that of the entry node `here` only if it gives no answer itself.
    fn blamed(self, here: (NodeAddress, &str), there: NodeAddress, names: &Names) -> SystemError {
        let (here, path) = here;
        match self {
            Self::NotAsked(why) => SystemError::NoAnswer(path.to_owned(), why),
            Self::NotAnswered(why) if here == there => SystemError::NoAnswer(path.to_owned(), why),
            Self::NotAnswered(why) | Self::Refused(why) => {
                SystemError::ItsNode(names.of_node(there), clean(&why))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use sinew::{Outcome, message::Rejection};

    use super::*;
    use crate::{EXIT_FINDING, EXIT_NO_NODE, system::Answer};

    const HIP: NodeAddress = NodeAddress::new(0x0a00_0001);
    const KNEE: NodeAddress = NodeAddress::new(0x0a00_0002);

    /// Returns the text and the exit code if the hip accepted the command.
    fn blamed(vain: WatchError, there: NodeAddress, names: &Names) -> (String, u8) {
        let fault = vain.blamed((HIP, "/run/hip.sock"), there, names);
        (fault.to_string(), fault.code())
    }

    /// The knee has not reported its applications.
    fn names() -> Names {
        let result = Err("no answer".to_owned());
        Names::of(vec![Answer { node: KNEE, name: "knee".to_owned(), result }])
    }

    #[test]
    fn failure_is_attributed_to_the_node_of_the_application() {
        for error in [
            ApiError::NoReply(Duration::from_secs(2)),
            ApiError::Ended(Outcome::Rejected(Rejection::NoSuchNode)),
        ] {
            let (text, code) = blamed(WatchError::of(&error), KNEE, &names());
            assert_eq!(text, format!("the application's node knee at 10.0.0.2: {}", in_words(&error)));
            assert_eq!(code, EXIT_FINDING);
        }
        let refused = || WatchError::Refused("this node shows 8 watches at once".to_owned());
        let words = "the application's node knee at 10.0.0.2: this node shows 8 watches at once";
        assert_eq!(blamed(refused(), KNEE, &names()), (words.to_owned(), EXIT_FINDING));
        // A node that answers is not reported as silent, wherever it is.
        let words = "the application's node 10.0.0.1: this node shows 8 watches at once";
        assert_eq!(blamed(refused(), HIP, &names()), (words.to_owned(), EXIT_FINDING));
    }

    #[test]
    fn failure_of_the_accepting_node_is_attributed_to_it() {
        let silent = ApiError::NoReply(Duration::from_secs(2));
        let ended = ApiError::Closed("it was closed".to_owned());
        for (error, there) in [(silent, HIP), (ended, KNEE)] {
            let (text, code) = blamed(WatchError::of(&error), there, &names());
            assert_eq!(
                (text, code),
                (format!("the node at /run/hip.sock: {}", in_words(&error)), EXIT_NO_NODE)
            );
        }
    }
}
