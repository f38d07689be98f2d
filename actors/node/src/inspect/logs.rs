//! Hands out the newest lines of the node's log. spec: INSPECT-11

use std::sync::Arc;

use sinew_runtime::{log::tracing::Level, outcome::Rejection, time::Time, wire::Message};

use super::reports::{AskLogs, LOG_LINES_MAX, LogLine, LogsReport};
use crate::{
    NodeState,
    log_ring::{Found, Line, Wanted},
};

/// Maximum bytes of targets and texts in one answer, plus one line.
const BYTES_MAX: usize = 32 * 1024;

/// Returns the lines from the number of the question on.
pub(super) fn kept(state: &Arc<NodeState>, question: &Message) -> Result<LogsReport, Rejection> {
    let AskLogs { from, level, newest } = question.decode().map_err(|_| Rejection::Malformed)?;
    let level = level.as_deref().map_or(Ok(Level::TRACE), str::parse).map_err(|_| Rejection::Malformed)?;
    let bytes_max = BYTES_MAX.min(state.ctx.config.payload_max / 2);
    let lines_max = newest.map_or(LOG_LINES_MAX, |newest| LOG_LINES_MAX.min(newest as usize));
    let wanted = Wanted { from, level, lines_max, bytes_max };
    let found = if newest.is_some() { state.log.newest(wanted) } else { state.log.read(wanted) };
    let Found { lines, next, more, lost } = found;
    Ok(LogsReport {
        name: state.ctx.config.name.clone(),
        incarnation: state.ctx.incarnation,
        now_ns: Time::now().as_nanos(),
        lines: lines.iter().map(|line| reported(line)).collect(),
        next,
        more,
        lost,
    })
}

fn reported(line: &Line) -> LogLine {
    let Line { number, at, level, target, text, .. } = line;
    LogLine {
        number: *number,
        at_ns: at.as_nanos(),
        level: level.as_str().to_ascii_lowercase(),
        target: target.clone(),
        text: text.clone(),
    }
}

#[cfg(test)]
mod tests {
    use sinew_model::config::NodeConfig;
    use sinew_runtime::{
        log::LogObserver as _,
        tid::{Incarnation, Tid},
    };

    use super::*;

    // spec: INSPECT-11
    #[test]
    fn lines_are_handed_out_by_number_and_level() {
        let state = NodeState::for_test(NodeConfig::new("knee"), Incarnation(3));
        // Other tests of this process log, too.
        let target = "sinew::test_of_kept_lines";
        state.log.wrote(Level::WARN, target, "first");
        state.log.wrote(Level::INFO, target, "second");
        state.log.wrote(Level::ERROR, target, "third");
        let ask = |question: &AskLogs| kept(&state, &Message::typed(Tid::NONE, Tid::NONE, question));
        let texts = |report: &LogsReport| -> Vec<(String, String)> {
            let own = report.lines.iter().filter(|line| line.target == target);
            own.map(|line| (line.level.clone(), line.text.clone())).collect()
        };
        let pair = |level: &str, text: &str| (level.to_owned(), text.to_owned());
        let all = ask(&AskLogs::default()).expect("it is a question");
        assert_eq!((all.name.as_str(), all.incarnation), ("knee", Incarnation(3)));
        let words = [("warn", "first"), ("info", "second"), ("error", "third")];
        assert_eq!(texts(&all), words.map(|(level, text)| pair(level, text)));
        assert!(all.lines.iter().all(|line| line.at_ns <= all.now_ns && line.number < all.next));
        let severe = AskLogs { level: Some("warn".to_owned()), ..AskLogs::default() };
        let severe = ask(&severe).expect("it is a question");
        assert_eq!(texts(&severe), [pair("warn", "first"), pair("error", "third")]);
        let later = ask(&AskLogs { from: all.next, ..AskLogs::default() }).expect("it is a question");
        assert!(texts(&later).is_empty());
        let wrong = AskLogs { level: Some("loud".to_owned()), ..AskLogs::default() };
        assert_eq!(ask(&wrong), Err(Rejection::Malformed));
    }
}
