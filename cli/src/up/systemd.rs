//! `sinew up --systemd`: places the files of all nodes, and writes their units. It starts nothing.

use serde_json::json;

use super::{
    gather::gather,
    protocol::Request,
    robot::{HERE, Robot},
    run::{Printer, enter, failed, unchanged},
    session::Access,
    units::{self, UnitOrder, unit_name},
};
use crate::{Report, system::SystemError};

/// Writes the units of all hosts, and returns the commands that install them.
pub(super) fn write(robot: &Robot, printer: Printer) -> Result<Report, SystemError> {
    let gathered = gather(robot);
    if !gathered.faults.is_empty() {
        return Err(unchanged(&gathered.faults));
    }
    let (mut fleet, seen) = enter(robot, Access::Change)?;
    let running = seen.values().flatten().filter(|node| node.process.is_some());
    let running: Vec<_> = running.map(|node| format!("{} runs already", node.order.name)).collect();
    if !running.is_empty() {
        let remedy = "systemd would start a second process of each; stop them first: sinew down".to_owned();
        return Err(unchanged(&[running, vec![remedy]].concat()));
    }
    let (mut commands, mut written) = (String::new(), Vec::new());
    for (host, spec) in &robot.hosts {
        let on_host = || gathered.wanted.iter().filter(|(_, node)| node.host == *host);
        fleet.send(host, on_host().map(|(_, node)| &node.order), &gathered.contents).map_err(failed)?;
        let folder = fleet.folder(host).to_owned();
        let mut paths = Vec::new();
        for (_, node) in on_host() {
            let is_here = |name: &&String| robot.nodes.get(*name).is_some_and(|other| other.host == *host);
            let after: Vec<_> = node.after.iter().filter(is_here).cloned().collect();
            let unit = units::service(&UnitOrder {
                robot: &robot.name,
                order: &node.order,
                after: &after,
                user: spec.user.as_deref(),
                folder: &folder,
                stop_within: robot.stop_within,
            });
            let order = Request::WriteUnit { order: node.order.clone(), unit };
            paths.push(fleet.order(host, &order).map_err(failed)?);
        }
        let names: Vec<_> = on_host().map(|(name, _)| name.as_str()).collect();
        if names.is_empty() {
            continue;
        }
        paths.push(
            fleet.order(host, &Request::WriteTarget(units::target(&robot.name, &names))).map_err(failed)?,
        );
        let target = unit_name(&robot.name, "", "target");
        let place = if host == HERE { "this host".to_owned() } else { format!("host {host}") };
        commands += &format!(
            "on {place}, as root:\n  systemd-analyze verify {0}/units/*.service\n  systemctl link {0}/units/*\n  \
             systemctl enable --now '{target}'\n",
            crate::table::quoted(&folder.display().to_string()),
        );
        written.push(json!({ "host": host, "units": paths }));
    }
    printer.line("the files are placed, and the units are written; nothing was started");
    Ok(Report { text: commands, json: json!({ "hosts": written }), is_fine: true })
}
