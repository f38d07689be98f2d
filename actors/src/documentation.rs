//! Whether the page on errors names each error.

/// The variants of the public enum `name` in a source.
fn variants<'s>(source: &'s str, name: &str) -> Vec<&'s str> {
    let body = source.split_once(&format!("pub enum {name} {{\n")).expect("the enum is there").1;
    let body = body.split_once("\n}\n").expect("it ends").0;
    let lines = body.lines().filter_map(|line| line.strip_prefix("    "));
    let variants = lines.filter(|line| line.starts_with(|first: char| first.is_ascii_uppercase()));
    variants.filter_map(|line| line.split(|end: char| !end.is_ascii_alphanumeric()).next()).collect()
}

#[test]
fn the_page_on_errors_names_each_one() {
    let page = include_str!("../../docs/book/src/reference/errors.md");
    let client = include_str!("../client/src/error.rs");
    let sender = include_str!("../../runtime/src/sender.rs");
    let outcome = include_str!("../../runtime/src/outcome.rs");
    let commands = include_str!("../node/src/commands.rs");
    for (name, source) in [
        ("Outcome", outcome),
        ("Rejection", outcome),
        ("StartError", include_str!("../node/src/builder/start_error.rs")),
        ("ApiError", client),
        ("SendError", sender),
        ("AskError", sender),
        ("BarrierError", include_str!("../client/src/barrier.rs")),
        ("ParameterError", include_str!("../params/src/tuner.rs")),
        ("SealError", include_str!("../../runtime/src/protection/ends.rs")),
        ("ArmError", include_str!("../../runtime/src/protection/mod.rs")),
        ("RunError", include_str!("../replay/src/error.rs")),
        ("CommandError", commands),
        ("AuditError", include_str!("../node/src/audits.rs")),
        ("AccessError", include_str!("../security/src/access/guard.rs")),
        ("DenyListError", include_str!("../security/src/node_security.rs")),
    ] {
        let sections = page.split("\n## ");
        let own =
            sections.filter(|section| section.lines().next().is_some_and(|heading| heading.contains(name)));
        let own: String = own.collect();
        let found = variants(source, name);
        assert!(found.len() > 1, "{name}: {found:?}");
        for variant in found {
            let forms = [format!("`{variant}`"), format!("`{variant}(")];
            let is_named =
                forms.iter().any(|form| own.contains(form)) || page.contains(&format!("`{name}::{variant}`"));
            assert!(is_named, "docs/book/src/reference/errors.md has no row for {name}::{variant}");
        }
    }
}
