//! The parts of one recording: each continues the one before.

use super::{
    Finding, Kind,
    file::{Checked, Tallied},
};

/// Compares each part with the one before. `files` are in the order of nodes and parts.
pub(super) fn compare(files: &[Checked], findings: &mut Vec<Finding>) {
    let recording = |file: &Checked| {
        let (address, incarnation, began_ns, _) = file.order();
        (address.to_owned(), incarnation, began_ns)
    };
    for group in files.chunk_by(|one, other| recording(one) == recording(other)) {
        let mut before: Option<&Checked> = None;
        for file in group {
            let part = file.report.part;
            let expected = before.map_or(0, |before| before.report.part.saturating_add(1));
            match before {
                Some(before) if before.report.part == part => {
                    findings.push(finding(file, "", format!("part {part} is given twice")));
                }
                _ if part != expected => {
                    let text = match part - expected {
                        1 => format!("part {expected} is absent: give this file, too"),
                        _ => format!("parts {expected} to {} are absent: give these files, too", part - 1),
                    };
                    findings.push(finding(file, "", text));
                }
                Some(before) => continues(before, file, findings),
                None => {}
            }
            before = Some(file);
        }
    }
}

/// The counters with which a part begins are those with which the one before ended, and of an unfinished one also the
/// messages behind its last tally.
fn continues(before: &Checked, file: &Checked, findings: &mut Vec<Finding>) {
    for (topic, counted) in &before.channels {
        let base = file.channels.get(topic).and_then(|counted| counted.base.as_ref());
        let after = before.report.channels.iter().find(|channel| channel.topic == *topic);
        let after = after.map_or(0, |channel| channel.after_tally);
        let last = &counted.last;
        let (Tallied { written, .. }, expected) = match base {
            Some(base) => (base, u128::from(last.written) + u128::from(after)),
            None => {
                let text = "this part does not begin with the counters of this channel".to_owned();
                findings.push(finding(file, topic, text));
                continue;
            }
        };
        if u128::from(*written) != expected {
            let text = format!(
                "the part before ended with {expected} written messages, this one begins with {written}"
            );
            findings.push(finding(file, topic, text));
        }
    }
}

fn finding(file: &Checked, topic: &str, text: String) -> Finding {
    Finding {
        kind: Kind::Part,
        file: file.report.file.clone(),
        topic: topic.to_owned(),
        text,
        from_ns: 0,
        to_ns: 0,
    }
}
