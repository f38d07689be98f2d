//! Rules for the layout: the packages and their directions, and the folders within a package.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use serde_json::Value;

/// The layers. None of them may stand on another one.
const LAYERS: [&str; 4] = ["sinew-lncl", "sinew-gncl", "sinew-ndl", "sinew-sync"];
/// The only package that stands on all layers. (`sinew` names some for its reports and for fuzzers.)
const NODE: &str = "sinew-node";
/// The line of docs/ARCHITECTURE.md above the picture of the packages.
const MARKER: &str = "<!-- packages:";

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("tests/ is in the root")
}

/// Returns the packages of this workspace, and the others of them that each needs outside of tests.
fn packages() -> BTreeMap<String, BTreeSet<String>> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(cargo)
        .args(["metadata", "--no-deps", "--offline", "--format-version", "1"])
        .current_dir(root())
        .output()
        .expect("cargo runs");
    let metadata: Value = serde_json::from_slice(&output.stdout).expect("cargo writes JSON");
    let all = metadata["packages"].as_array().expect("a list of packages");
    let name = |of: &Value| of["name"].as_str().expect("it has a name").to_owned();
    let own: BTreeSet<_> = all.iter().map(name).collect();
    let needs = |package: &Value| {
        let all = package["dependencies"].as_array().expect("a list of dependencies").iter();
        let normal = all.filter(|needed| needed["kind"].is_null() && needed["optional"] != true);
        normal.map(name).filter(|needed| own.contains(needed)).collect()
    };
    all.iter().map(|package| (name(package), needs(package))).collect()
}

/// Returns everything that a package stands on.
fn below(packages: &BTreeMap<String, BTreeSet<String>>, package: &str) -> BTreeSet<String> {
    let (mut open, mut found) = (vec![package.to_owned()], BTreeSet::new());
    while let Some(next) = open.pop() {
        let needs = packages.get(&next).into_iter().flatten();
        open.extend(needs.filter(|needed| found.insert((*needed).clone())).cloned());
    }
    found
}

#[test]
fn no_layer_stands_on_another_one() {
    let packages = packages();
    for layer in LAYERS {
        let below = below(&packages, layer);
        assert!(!below.contains(NODE), "{layer} stands on {NODE}");
        for other in LAYERS {
            assert!(!below.contains(other), "{layer} stands on {other}");
        }
    }
    assert!(LAYERS.iter().all(|layer| packages[NODE].contains(*layer)), "{NODE} names all layers");
}

#[test]
fn client_and_c_library_stand_on_no_layer() {
    let packages = packages();
    for package in ["sinew-client", "sinew-c"] {
        let below = below(&packages, package);
        let unwanted = LAYERS.into_iter().chain([NODE, "sinew", "sinew-security", "sinew-session"]);
        for other in unwanted {
            assert!(!below.contains(other), "{package} stands on {other}");
        }
    }
}

#[test]
fn picture_of_the_packages_is_true() {
    let page = fs::read_to_string(root().join("docs/ARCHITECTURE.md")).expect("the page is there");
    let (_, rest) = page.split_once(MARKER).expect("the page has the marker");
    let block = rest.split("```").nth(1).expect("a block follows");
    let packages = packages();
    let mut shown = BTreeSet::new();
    for line in block.lines().filter(|line| line.contains("->")) {
        let (name, needs) = line.split_once("->").expect("it has an arrow");
        let name = name.trim();
        let needs: BTreeSet<_> = needs.split_whitespace().map(str::to_owned).collect();
        assert_eq!(packages.get(name), Some(&needs), "docs/ARCHITECTURE.md, line of {name}");
        for needed in &needs {
            assert!(shown.contains(needed), "docs/ARCHITECTURE.md: {name} stands above {needed}");
        }
        shown.insert(name.to_owned());
    }
    for package in
        below(&packages, "sinew").iter().map(String::as_str).chain(["sinew", "sinew-c", "sinew-cli"])
    {
        assert!(shown.contains(package), "docs/ARCHITECTURE.md does not show {package}");
    }
}

/// Returns the sources of a package, without tests.
fn sources(package: &Path) -> Vec<PathBuf> {
    let (mut folders, mut found) = (vec![package.join("src")], Vec::new());
    while let Some(folder) = folders.pop() {
        let Ok(entries) = fs::read_dir(&folder) else { continue };
        for entry in entries {
            let path = entry.expect("the folder is readable").path();
            let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            let is_test = name.ends_with("tests") || ["testing", "model"].contains(&&*name);
            if path.is_dir() && !is_test {
                folders.push(path);
            } else if path.extension().is_some_and(|ending| ending == "rs") && !is_test {
                found.push(path);
            }
        }
    }
    found
}

/// Returns the modules at the top of a package that each of them imports by `crate::`.
fn imports(package: &Path) -> BTreeMap<String, BTreeSet<String>> {
    let src = package.join("src");
    let top = |path: &Path| {
        let first = path.strip_prefix(&src).ok()?.components().next()?;
        Some(Path::new(first.as_os_str()).file_stem()?.to_string_lossy().into_owned())
    };
    let files = sources(package);
    let folders: BTreeSet<_> = fs::read_dir(&src)
        .into_iter()
        .flatten()
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| path.is_dir())
        .filter_map(|path| Some(path.file_name()?.to_string_lossy().into_owned()))
        .collect();
    let mut arrows: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for file in files {
        let Some(from) = top(&file).filter(|from| folders.contains(from)) else { continue };
        let text = fs::read_to_string(&file).expect("a source is text");
        let code = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
        for (at, _) in code.match_indices("crate::") {
            let line_start = code[..at].rfind('\n').map_or(0, |end| end + 1);
            if code[line_start..at].trim_start().starts_with("//") {
                continue;
            }
            let rest = &code[at + "crate::".len()..];
            let names: Vec<&str> = match rest.strip_prefix('{') {
                Some(group) => members(group),
                None => vec![rest],
            };
            for name in names {
                let name: String =
                    name.chars().take_while(|letter| letter.is_alphanumeric() || *letter == '_').collect();
                if folders.contains(&name) && name != from {
                    arrows.entry(from.clone()).or_default().insert(name);
                }
            }
        }
    }
    arrows
}

/// Returns the members of an import's group, which follows the opening brace.
fn members(group: &str) -> Vec<&str> {
    let (mut depth, mut start, mut found) = (0_usize, 0, Vec::new());
    for (at, letter) in group.char_indices() {
        match letter {
            '{' => depth += 1,
            '}' if depth == 0 => {
                found.push(group[start..at].trim_start());
                break;
            }
            '}' => depth -= 1,
            ',' if depth == 0 => {
                found.push(group[start..at].trim_start());
                start = at + 1;
            }
            _ => {}
        }
    }
    found
}

/// Returns a circle of imports, if there is one.
fn circle(arrows: &BTreeMap<String, BTreeSet<String>>) -> Option<(String, String)> {
    let pairs = arrows.iter().flat_map(|(from, to)| to.iter().map(move |to| (from, to)));
    let mut circles = pairs.filter(|(from, to)| below(arrows, to).contains(*from));
    circles.next().map(|(from, to)| (from.clone(), to.clone()))
}

#[test]
fn sibling_folders_import_in_one_direction() {
    let metadata = [
        "runtime",
        "runtime/shm",
        "cli",
        "bindings/c",
        "actors",
        "examples/exoskeleton",
        "examples/exoskeleton/model",
        "tests",
        "tests/testkit",
    ];
    let layers = fs::read_dir(root().join("actors")).expect("the folder is there");
    let layers = layers.filter_map(|entry| Some(entry.ok()?.path()));
    let packages = metadata.iter().map(|folder| root().join(folder)).chain(layers);
    for package in packages.filter(|folder| folder.join("Cargo.toml").is_file()) {
        if let Some((one, other)) = circle(&imports(&package)) {
            panic!(
                "{}: src/{one} and src/{other} import each other, directly or by others",
                package.display()
            );
        }
    }
}

#[test]
fn rules_find_planted_circles() {
    assert_eq!(members("one::Thing, two::{A, B}, three}; more, of"), ["one::Thing", "two::{A, B}", "three"]);
    let arrow = |from: &str, to: &str| (from.to_owned(), BTreeSet::from([to.to_owned()]));
    let straight = BTreeMap::from([arrow("one", "two"), arrow("two", "three")]);
    assert_eq!(circle(&straight), None);
    let bent = BTreeMap::from([arrow("one", "two"), arrow("two", "three"), arrow("three", "one")]);
    assert_eq!(
        circle(&bent),
        Some(("one".to_owned(), "three".to_owned())).map(|_| ("one".to_owned(), "two".to_owned()))
    );
}
