//! The page at `/`: a link to the metrics, and the nodes with their states. No scripts.

use std::fmt::Write as _;

use sinew::Time;

use crate::{
    nodes::{NodeLabels, NodeRow, State, rows},
    snapshot::Snapshot,
};

const HEAD: &str = "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>sinew view</title>\
    <style>body{font-family:sans-serif;margin:2em}td,th{text-align:left;padding:.2em 1em .2em 0}</style>\
    </head><body>\n<h1>sinew view</h1>\n<p><a href=\"/metrics\">metrics</a></p>\n";

/// Returns the page.
pub(crate) fn html(snapshot: &Snapshot, now: Time) -> String {
    let mut page = HEAD.to_owned();
    if let Err(why) = &snapshot.entry {
        let _ = writeln!(page, "<p>The entry node gives no answer: {}</p>", escaped(why));
    }
    page += "<table>\n<tr><th>node</th><th>address</th><th>state</th></tr>\n";
    for NodeRow { node, label, state } in rows(snapshot, &NodeLabels::of(snapshot)) {
        let (label, state) = (escaped(&label), escaped(&in_words(&state)));
        let _ = writeln!(page, "<tr><td>{label}</td><td>{node}</td><td>{state}</td></tr>");
    }
    let age = now.since(snapshot.taken).as_secs_f64();
    let _ = writeln!(page, "</table>\n<p>asked {age:.1} s ago</p>\n</body></html>");
    page
}

fn in_words(state: &State) -> String {
    match state {
        State::Up => "up".to_owned(),
        State::Stops => "stops".to_owned(),
        State::Lost(_, why) => format!("lost: {why}"),
        State::Silent(why) => format!("no answer: {why}"),
    }
}

/// Returns a text of another node so that it cannot be read as HTML.
fn escaped(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            '&' => safe += "&amp;",
            '<' => safe += "&lt;",
            '>' => safe += "&gt;",
            '"' => safe += "&quot;",
            '\'' => safe += "&#39;",
            other if other.is_control() => safe.push(' '),
            other => safe.push(other),
        }
    }
    safe
}

#[cfg(test)]
mod tests {
    use sinew::NodeAddress;

    use super::*;
    use crate::metrics::tests::{lost, snapshot};

    #[test]
    fn nodes_are_listed_and_their_texts_are_no_html() {
        let mut snapshot = snapshot();
        let Ok(entry) = &mut snapshot.entry else { panic!("it has answered") };
        entry.lost.push(lost(NodeAddress::from([10, 0, 0, 9]), "<b>knee", "gave up: \"x\" & y"));
        let page = html(&snapshot, snapshot.taken);
        assert!(page.contains("<td>hip</td><td>10.0.0.1</td><td>up</td>"), "{page}");
        assert!(
            page.contains("&lt;b&gt;knee") && page.contains("lost: gave up: &quot;x&quot; &amp; y"),
            "{page}"
        );
        assert!(!page.contains("<b>") && !page.contains("<script"), "{page}");
    }

    #[test]
    fn page_says_why_the_entry_node_is_silent() {
        let page = html(
            &Snapshot::without_entry(Time::from_nanos(0), "it <stopped>".to_owned()),
            Time::from_nanos(0),
        );
        assert!(page.contains("gives no answer: it &lt;stopped&gt;"), "{page}");
    }
}
