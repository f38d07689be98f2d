//! `sinew top`: nodes, applications, links and losses on a terminal.
//!
//! It takes the snapshots of `sinew view`, twice a second, and shows their differences as rates. Where standard
//! output is no terminal it prints one table.

mod controls;
mod lines;
mod model;
mod terminal;

use std::{
    io::{self, IsTerminal as _},
    time::Duration,
};

use sinew_view::Source as _;

use crate::{Report, arguments::Arguments, system::SystemError, view::Nodes};
use model::Model;

/// Time between the two snapshots of one table: the rates are those within it.
const RATES_PERIOD: Duration = Duration::from_secs(1);

/// Shows the system until the user ends it, or once where standard output is no terminal.
pub(crate) fn show(arguments: &Arguments) -> Result<Report, SystemError> {
    let (nodes, first) = Nodes::enter(arguments)?;
    if !arguments.json && io::stdout().is_terminal() {
        let end = terminal::run(nodes, first);
        end.map_err(|why| {
            SystemError::View(format!(
                "the terminal cannot be used: {why}; `sinew top | cat` prints one table"
            ))
        })?;
        return Ok(Report { text: String::new(), json: serde_json::Value::Null, is_fine: true });
    }
    std::thread::sleep(RATES_PERIOD);
    let now = nodes.snapshot();
    let model = Model::of(Some(&first), &now);
    if let Some(why) = &model.fault {
        return Err(SystemError::NoAnswer(nodes.path(), why.clone()));
    }
    Ok(Report { text: text(&model), json: model.json(), is_fine: model.is_fine() })
}

/// Returns the tables as plain text.
fn text(model: &Model) -> String {
    let mut text: String = lines::lines(model, "").iter().map(|line| format!("{}\n", line.text)).collect();
    if model.left_out > 0 {
        text += &format!("{} further nodes were not asked\n", model.left_out);
    }
    text
}
