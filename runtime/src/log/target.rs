//! The target of an event: the layer that logs it, as `SINEW_LOG` names it.

/// The packages of the layers, and parts of them, with their targets; a part is before its package. `sinew::gncl`
/// stays the target of GNCL wherever its code is.
const TARGETS: [(&str, &str); 22] = [
    ("sinew_client", "sinew::client"),
    ("sinew_gncl::node_down_events", "sinew::aftermath"),
    ("sinew_gncl", "sinew::gncl"),
    ("sinew_lncl::undelivered", "sinew::undelivered"),
    ("sinew_lncl", "sinew::lncl"),
    ("sinew_model::log_quotas", "sinew::log_quotas"),
    ("sinew_model::refusals", "sinew::refusals"),
    ("sinew_ndl", "sinew::ndl"),
    ("sinew_node::audit", "sinew::audit"),
    ("sinew_node::inspect", "sinew::inspect"),
    ("sinew_node::process", "sinew::process"),
    ("sinew_node::signals", "sinew::signals"),
    ("sinew_node::types", "sinew::types"),
    ("sinew_node", "sinew::node"),
    ("sinew_protocol", "sinew::protocol"),
    ("sinew_security::access", "sinew::access"),
    ("sinew_security::node_security", "sinew::secured"),
    ("sinew_security", "sinew::security"),
    ("sinew_session", "sinew::session"),
    ("sinew_sync::monitors", "sinew::monitors"),
    ("sinew_sync::wills", "sinew::wills"),
    ("sinew_sync", "sinew::sync"),
];

/// Returns the target of the events of a module. That of any other module is its path.
#[must_use]
pub const fn target(module: &'static str) -> &'static str {
    let mut at = 0;
    while at < TARGETS.len() {
        let (package, target) = TARGETS[at];
        if is_in(module.as_bytes(), package.as_bytes()) {
            return target;
        }
        at += 1;
    }
    module
}

/// Returns whether `module` is `package`, or in it.
const fn is_in(module: &[u8], package: &[u8]) -> bool {
    if module.len() < package.len() {
        return false;
    }
    let mut at = 0;
    while at < package.len() {
        if module[at] != package[at] {
            return false;
        }
        at += 1;
    }
    module.len() == package.len() || module[package.len()] == b':'
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layer_keeps_its_target_in_any_package() {
        let targets =
            ["sinew_gncl", "sinew_gncl::actor::wire", "sinew_model::refusals", "sinew_runtime::app", "sinew"];
        let expected = ["sinew::gncl", "sinew::gncl", "sinew::refusals", "sinew_runtime::app", "sinew"];
        assert_eq!(targets.map(target), expected);
        assert_eq!(target("sinew_nodes::own"), "sinew_nodes::own", "another package");
    }
}
