//! Whether an application handles the types of the messages that it gets.

use sinew::inspect::UnhandledReport;

use super::{End, RECENT_US, Steps};
use crate::table::time;

impl Steps {
    /// Messages that `to` did not handle or could not read: of `from` they stand in the way, of others they are told.
    pub(super) fn handled(&mut self, from: &End, to: &End) {
        let Some(receiver) = to.app.as_ref().and_then(|app| app.report.as_ref()).map(|app| app.tid) else {
            return;
        };
        let sender = from.app.as_ref().and_then(|app| app.report.as_ref()).map(|app| app.tid);
        let unhandled = to.report.iter().flat_map(|report| &report.unhandled);
        for said in unhandled.filter(|said| said.receiver == receiver) {
            let what = format!("{} handles what it is sent", to.label());
            let is_of_it = sender == Some(said.sender);
            let kind = said.kind_name.clone().or_else(|| name_at(from, said));
            let seen = seen(said, kind, if is_of_it { Some(from.label()) } else { None });
            if is_of_it && said.ago_us < RECENT_US {
                self.blocked(what, seen, said.remedy.clone());
            } else {
                self.note(what, seen, said.remedy.clone());
            }
        }
    }
}

/// The name of the type at its sender: a receiver that does not handle it does not know its name.
fn name_at(sender: &End, said: &UnhandledReport) -> Option<String> {
    let mut known = sender.report.iter().flat_map(|report| &report.unhandled);
    known.find(|known| known.kind == said.kind)?.kind_name.clone()
}

fn seen(said: &UnhandledReport, name: Option<String>, sender: Option<&str>) -> String {
    let UnhandledReport { sender: tid, kind, count, ago_us, is_malformed, .. } = said;
    let kind = name.unwrap_or_else(|| format!("kind {kind}"));
    let sender = sender.map_or_else(|| tid.to_string(), str::to_owned);
    let ago = time(*ago_us);
    let messages = if *count == 1 { "1 message".to_owned() } else { format!("{count} messages") };
    if *is_malformed {
        format!("{messages} of {kind} could not be read, the last one {ago} ago from {sender}")
    } else {
        format!("{kind} is not handled: {messages}, the last one {ago} ago from {sender}")
    }
}
