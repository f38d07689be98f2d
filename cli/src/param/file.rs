//! `sinew param save` and `load`: a TOML file with a table for each application.

use std::{
    fs,
    io::{Read as _, Write as _},
    path::Path,
};

use serde_json::json;
use sinew::parameters::{
    PARTICIPANTS_MAX,
    file::{self, FILE_BYTES_MAX, ValuesOfApps},
};

use super::{list, targets};
use crate::{
    Report,
    system::{System, SystemError},
    table::{clean, clean_lines},
};

/// The first line of a file.
const HEAD: &str = "# Values of parameters, a table for each application. `sinew param load` sets them.\n\n";

/// Writes the values of these applications, or of all, to a file. A value that moves is written as its target.
pub(super) fn save(system: &mut System, path: &Path, apps: &[String]) -> Result<Report, SystemError> {
    let (listed, silent) = if apps.is_empty() {
        list::all(system)?
    } else {
        let listed: Result<Vec<_>, _> = apps.iter().map(|app| list::one(system, app)).collect();
        (listed?, Vec::new())
    };
    let mut values = ValuesOfApps::new();
    let mut faults = silent;
    for list::Listed { app, result, .. } in &listed {
        match result {
            Ok(list) => {
                if values.insert(app.clone(), targets(list)).is_some() {
                    let app = clean(app);
                    faults.push(format!("{app}: several applications have this name; name one by its TID"));
                }
            }
            Err(why) => faults.push(format!("{}: {}", clean(app), clean(why))),
        }
    }
    if !faults.is_empty() {
        let faults = faults.join("\n");
        return Err(SystemError::Unknown(format!(
            "nothing was written, as the values are not complete:\n{faults}"
        )));
    }
    let text = format!("{HEAD}{}", file::text(&values));
    let shown = path.display().to_string();
    replace(path, &text).map_err(|error| {
        SystemError::Bag(format!("{shown} cannot be written: {error}; choose a folder that you may write to"))
    })?;
    let count = values.len();
    let text = format!("the parameters of {count} applications are in {}\n", clean(&shown));
    Ok(Report {
        text,
        json: json!({ "file": shown, "apps": values.keys().collect::<Vec<_>>() }),
        is_fine: true,
    })
}

/// Sets the values of a file: those of several applications as one transaction, if there are not too many.
pub(super) fn load(system: &mut System, path: &Path) -> Result<Report, SystemError> {
    let sets = read(path)?;
    let sets: Vec<_> = sets.into_iter().collect();
    let (mut text, mut reports, mut is_fine) = (String::new(), Vec::new(), true);
    for sets in sets.chunks(PARTICIPANTS_MAX) {
        let report = super::set_all(system, sets.to_vec())?;
        text += &report.text;
        is_fine &= report.is_fine;
        reports.push(report.json);
    }
    Ok(Report { text, json: json!({ "sets": reports }), is_fine })
}

/// Replaces the file by one with this text: readers see the former one or the new one, never a part.
fn replace(path: &Path, text: &str) -> std::io::Result<()> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{}.new", std::process::id()));
    let new = path.with_file_name(name);
    let written = fs::File::create(&new).and_then(|mut file| {
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        fs::rename(&new, path)
    });
    if written.is_err() {
        // The cause of the failure is reported; a remainder is a file of a few bytes.
        let _ = fs::remove_file(&new);
    }
    written
}

/// Reads the sets of a file.
fn read(path: &Path) -> Result<ValuesOfApps, SystemError> {
    let shown = clean(&path.display().to_string());
    let mut text = String::new();
    let opened = fs::File::open(path);
    let read = opened.and_then(|file| file.take(FILE_BYTES_MAX + 1).read_to_string(&mut text));
    read.map_err(|error| SystemError::Bag(format!("{shown} cannot be read: {error}")))?;
    if text.len() as u64 > FILE_BYTES_MAX {
        return Err(SystemError::Bag(format!("{shown} is longer than 1 MiB: split it")));
    }
    file::parse(&text).map_err(|why| SystemError::Bag(format!("{shown}: {}", clean_lines(&why))))
}
