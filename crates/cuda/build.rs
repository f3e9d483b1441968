//! Writes Rust structs for the arguments of every kernel in `src`, and for the structs and whole-number constants that these
//! are made of, so that each is declared once, in CUDA. `src/kernels.rs` includes the result.
//!
//! It reads the C++ that the kernels' signatures are written in, not all of C++, and fails with the place of what it does not know.
//! That both languages lay the structs out alike is asserted when the kernels are compiled (`Program::checked_source`).

use std::{
    collections::{BTreeMap, BTreeSet},
    env,
    error::Error,
    fmt::Write as _,
    fs,
    path::{Path, PathBuf},
};

/// Numbers that the host gives to the compiler of the kernels (`Program::definitions`) and that the lengths of lists depend on:
/// their names in CUDA and in Rust.
const OF_THE_HOST: [(&str, &str); 5] = [
    ("DIM", "crate::kernels::AXES"),
    ("MATERIALS", "crate::kernels::MATERIALS"),
    ("MAX_LEVELS", "eddy_inference::kernels::nodes::MAX_LEVELS"),
    ("MAX_LISTS", "eddy_inference::checkpoint::grid::MAX_LISTS"),
    ("RULES", "eddy_inference::checkpoint::Rule::ALL.len()"),
];

#[expect(
    clippy::disallowed_methods,
    reason = "cargo says where to read and write by environment variables"
)]
fn main() -> Result<(), Box<dyn Error>> {
    // Not `env!`: checkouts that share a target folder share this program.
    let root = PathBuf::from(env::var("CARGO_MANIFEST_DIR")?).join("src");
    println!("cargo::rerun-if-changed=src");
    let mut files = Vec::new();
    collect(&root, &root, &mut files)?;
    files.sort_by(|left, right| left.module.cmp(&right.module));
    let all = All { files };
    let to = PathBuf::from(env::var("OUT_DIR")?).join("kernels.rs");
    fs::write(to, all.text()?)?;
    Ok(())
}

/// What the declaration of a kernel begins with.
const KERNEL: &str = "extern \"C\" __global__ void ";

/// A text of kernels.
struct File {
    /// Where it is in `src`, without the ending.
    module: Vec<String>,
    /// `#define NAME EXPRESSION`, for those that are defined once, without parameters and in one line.
    constants: BTreeMap<String, String>,
    structs: BTreeMap<String, Vec<Variable>>,
    /// In their order.
    kernels: Vec<(String, Vec<Variable>)>,
}

/// A field of a struct, or a parameter of a kernel.
#[derive(Clone)]
struct Variable {
    name: String,
    kind: String,
    pointer: bool,
    /// Lengths of an array of arrays, outermost first.
    lengths: Vec<String>,
}

fn collect(root: &Path, folder: &Path, files: &mut Vec<File>) -> Result<(), Box<dyn Error>> {
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() {
            collect(root, &path, files)?;
        } else if path.extension().is_some_and(|extension| extension == "cu") {
            let text = fs::read_to_string(&path)?;
            let module = path.strip_prefix(root)?.with_extension("");
            let words = module.iter().map(|word| word.to_string_lossy().into_owned());
            let file = File::parse(words.collect(), &text);
            files.push(file.map_err(|reason| format!("{}: {reason}", path.display()))?);
        }
    }
    Ok(())
}

impl File {
    fn parse(module: Vec<String>, text: &str) -> Result<Self, String> {
        let (mut code, mut constants, mut twice) = (String::new(), BTreeMap::new(), Vec::new());
        let mut conditions = 0;
        let mut lines = text.lines().map(|line| line.split("//").next().unwrap_or_default());
        while let Some(line) = lines.next() {
            if !line.starts_with('#') {
                code += line;
                code.push(' ');
                continue;
            }
            for (begin, end) in [("struct ", '}'), (KERNEL, '{')] {
                let declared = code.rfind(begin).map(|at| &code[at..]);
                if declared.is_some_and(|text| !text.contains([end, ';'])) {
                    return Err(format!("a directive within a declaration: {line}"));
                }
            }
            conditions +=
                i32::from(line.starts_with("#if")) - i32::from(line.starts_with("#endif"));
            if let Some(defined) = line.strip_prefix("#define ")
                && let Some((name, value)) = defined.split_once(' ')
                && !name.contains('(')
                && (conditions > 0
                    || constants.insert(name.to_owned(), value.trim().to_owned()).is_some())
            {
                twice.push(name.to_owned());
            }
            let mut last = line;
            while last.trim_end().ends_with('\\') {
                last = lines.next().unwrap_or_default();
            }
        }
        constants.retain(|name, _| !twice.contains(name));
        let mut file = Self { module, constants, structs: BTreeMap::new(), kernels: Vec::new() };
        file.find_structs(&code)?;
        file.find_kernels(&code)?;
        Ok(file)
    }

    fn find_structs(&mut self, code: &str) -> Result<(), String> {
        for (at, _) in code.match_indices("struct ") {
            let rest = without_attribute(&code[at + "struct ".len()..], "__align__");
            let Some((name, rest)) = rest.split_once('{') else { continue };
            let name = name.trim();
            if !is_name(name) {
                continue; // named only
            }
            let body = rest.split_once('}').map_or(rest, |(body, _)| body);
            let declared = body.split(';').map(str::trim).filter(|text| !text.is_empty());
            let fields = declared.map(variables).collect::<Result<Vec<_>, _>>();
            if self.structs.insert(name.to_owned(), fields?.concat()).is_some() {
                return Err(format!("struct {name} is declared twice"));
            }
        }
        Ok(())
    }

    fn find_kernels(&mut self, code: &str) -> Result<(), String> {
        for (at, _) in code.match_indices(KERNEL) {
            let rest = without_attribute(&code[at + KERNEL.len()..], "__launch_bounds__");
            let signature = rest
                .split_once('(')
                .and_then(|(name, rest)| Some((name.trim(), rest.split_once(')')?.0)));
            let Some((name, parameters)) = signature else {
                return Err(format!("a kernel without parameters: {rest:.60}"));
            };
            let parameters = parameters.split(',').map(variables).collect::<Result<Vec<_>, _>>()?;
            self.kernels.push((name.to_owned(), parameters.concat()));
        }
        Ok(())
    }
}

/// Without `ATTRIBUTE(..)` in front.
fn without_attribute<'a>(text: &'a str, attribute: &str) -> &'a str {
    let Some(rest) = text.trim_start().strip_prefix(attribute) else { return text.trim_start() };
    let mut depth = 0;
    let end = rest.find(|letter| {
        depth += i32::from(letter == '(') - i32::from(letter == ')');
        depth == 0
    });
    end.map_or("", |end| rest[end + 1..].trim_start())
}

fn is_name(text: &str) -> bool {
    let letters = |letter: char| letter.is_ascii_alphanumeric() || letter == '_';
    !text.is_empty() && text.chars().all(letters) && !text.starts_with(|c: char| c.is_ascii_digit())
}

/// What a declaration like `const float *a, b[2][3]` declares.
fn variables(declared: &str) -> Result<Vec<Variable>, String> {
    let unknown = || format!("a declaration that build.rs does not know: {declared}");
    let plain = declared.replace("__restrict__", " ").replace('*', " * ");
    let mut words: Vec<_> = plain.split_whitespace().filter(|word| *word != "const").collect();
    let of_two = matches!(words[..], ["unsigned", "char", ..] | ["long", "long", ..]);
    let kind = words.drain(..if of_two { 2 } else { 1 }).collect::<Vec<_>>().join(" ");
    if words.is_empty() {
        return Err(unknown());
    }
    let one = |text: &str| {
        let (stars, text) = (text.matches('*').count(), text.replace('*', " "));
        let mut parts = text.split('[');
        let name = parts.next().unwrap_or_default().trim();
        let lengths: Option<Vec<_>> =
            parts.map(|part| part.trim().strip_suffix(']').map(str::to_owned)).collect();
        match lengths {
            Some(lengths) if is_name(name) && stars < 2 => {
                let (name, kind) = (name.to_owned(), kind.clone());
                Ok(Variable { name, kind, pointer: stars == 1, lengths })
            }
            _ => Err(unknown()),
        }
    };
    words.join(" ").split(',').map(one).collect()
}

/// All texts.
struct All {
    files: Vec<File>,
}

impl All {
    /// The file that has something of a name: this one, or the only one.
    fn home<'a>(&'a self, from: &'a File, has: impl Fn(&File) -> bool) -> Option<&'a File> {
        if has(from) {
            return Some(from);
        }
        let mut homes = self.files.iter().filter(|file| has(file));
        homes.next().filter(|_| homes.next().is_none())
    }

    /// An expression of whole numbers in Rust; `None` if there is something else in it.
    fn expression(&self, from: &File, text: &str) -> Option<String> {
        let mut rust = String::new();
        let mut rest = text.trim();
        while let Some(first) = rest.chars().next() {
            let is_word = |letter: char| letter.is_ascii_alphanumeric() || letter == '_';
            let end = if is_word(first) {
                rest.find(|letter| !is_word(letter)).unwrap_or(rest.len())
            } else {
                first.len_utf8()
            };
            let (word, behind) = rest.split_at(end);
            rest = behind;
            if first.is_ascii_digit() {
                let number = word.trim_end_matches('u');
                let hexadecimal = number.strip_prefix("0x");
                let all_digits = hexadecimal.map_or_else(
                    || number.chars().all(|digit| digit.is_ascii_digit()),
                    |digits| digits.chars().all(|digit| digit.is_ascii_hexdigit()),
                );
                rust += all_digits.then_some(number)?;
            } else if let Some((_, name)) = OF_THE_HOST.iter().find(|(name, _)| *name == word) {
                rust += name;
            } else if is_word(first) {
                let home = self.home(from, |file| file.constants.contains_key(word))?;
                self.expression(home, &home.constants[word])?;
                rust += &format!("{}::{word}", home.path());
            } else if " ()+-*/<>".contains(first) {
                rust.push(first);
            } else {
                return None;
            }
        }
        Some(rust)
    }

    /// The type of a variable.
    fn kind(&self, from: &File, variable: &Variable) -> Result<String, String> {
        let Variable { kind, pointer, lengths, .. } = variable;
        let plain = match kind.as_str() {
            "float" => "f32",
            "double" => "f64",
            "int" => "i32",
            "u32" => "u32",
            "u64" => "u64",
            "long long" => "i64",
            "unsigned char" => "u8",
            "Body" => "crate::streams::Body",
            // Their alignment is not that of lists of numbers.
            "float2" if *pointer => "[f32; 2]",
            "float4" if *pointer => "[f32; 4]",
            "uint4" if *pointer => "[u32; 4]",
            name => {
                let home = self.home(from, |file| file.structs.contains_key(name));
                let home = home.ok_or_else(|| format!("{}: type {name}", from.path()))?;
                &format!("{}::{name}", home.path())
            }
        };
        let mut kind =
            if *pointer { format!("crate::device::Pointer<{plain}>") } else { plain.to_owned() };
        for length in lengths.iter().rev() {
            let number = self.expression(from, length);
            let number = number.ok_or_else(|| format!("{}: length {length}", from.path()))?;
            kind = format!("[{kind}; {number}]");
        }
        Ok(kind)
    }

    /// The structs that arguments are made of, by file and name.
    fn reached(&self) -> Result<BTreeSet<(String, String)>, String> {
        let mut reached = BTreeSet::new();
        let mut open: Vec<(&File, &[Variable])> = Vec::new();
        for file in &self.files {
            open.extend(file.kernels.iter().map(|(_, parameters)| (file, parameters.as_slice())));
        }
        while let Some((from, variables)) = open.pop() {
            for variable in variables {
                let name = &variable.kind;
                let home = self.home(from, |file| file.structs.contains_key(name));
                let Some(home) = home.filter(|_| name != "Body") else { continue };
                if reached.insert((home.path(), name.clone())) {
                    open.push((home, &home.structs[name]));
                }
            }
        }
        Ok(reached)
    }

    fn text(&self) -> Result<String, String> {
        let reached = self.reached()?;
        let (mut text, mut layouts) = (String::new(), String::new());
        let mut open: &[String] = &[];
        for file in &self.files {
            let (folders, name) = file.module.split_at(file.module.len() - 1);
            let shared = open.iter().zip(folders).take_while(|(left, right)| left == right).count();
            text += &"}\n".repeat(open.len() - shared);
            for folder in &folders[shared..] {
                let _ = writeln!(text, "pub mod {folder} {{");
            }
            open = folders;
            let _ = writeln!(text, "/// `{}.cu`.\npub mod {} {{", file.module.join("/"), name[0]);
            for (name, value) in &file.constants {
                if let Some(value) = self.expression(file, value) {
                    let _ = writeln!(text, "pub const {name}: usize = {value};");
                }
            }
            let own = |name: &String| reached.contains(&(file.path(), name.clone()));
            for (name, fields) in file.structs.iter().filter(|(name, _)| own(name)) {
                self.write_struct(&mut text, file, name, fields)?;
                let _ = write!(layouts, "({name:?}, size_of::<{}::{name}>()), ", file.path());
            }
            for (name, parameters) in &file.kernels {
                self.write_kernel(&mut text, file, name, parameters)?;
            }
            text += "}\n";
        }
        text += &"}\n".repeat(open.len());
        let _ = writeln!(
            text,
            "/// Name and size (bytes) of every struct above.\npub const LAYOUTS: &[(&str, usize)] = &[{layouts}];"
        );
        Ok(text)
    }

    fn write_fields(
        &self,
        text: &mut String,
        file: &File,
        fields: &[Variable],
    ) -> Result<Vec<String>, String> {
        fields
            .iter()
            .map(|field| {
                let kind = self.kind(file, field)?;
                let _ = writeln!(text, "    pub {}: {kind},", field.name);
                Ok(format!("size_of::<{kind}>()"))
            })
            .collect()
    }

    fn write_struct(
        &self,
        text: &mut String,
        file: &File,
        name: &str,
        fields: &[Variable],
    ) -> Result<(), String> {
        let _ = writeln!(
            text,
            "/// As the kernels have it.\n#[derive(Clone, Copy, Debug)]\n#[repr(C)]\npub struct {name} {{"
        );
        let sizes = self.write_fields(text, file, fields)?.join(" + ");
        let _ = writeln!(
            text,
            "}}\nconst _: () = assert!(size_of::<{name}>() == {sizes}, \"{name} needs a field for its padding\");"
        );
        let _ = writeln!(
            text,
            "// SAFETY: fields that are so themselves, without padding between them, as the size shows.\nunsafe impl bytemuck::Zeroable for {name} {{}}"
        );
        let _ = writeln!(text, "// SAFETY: as above.\nunsafe impl bytemuck::Pod for {name} {{}}");
        Ok(())
    }

    fn write_kernel(
        &self,
        text: &mut String,
        file: &File,
        name: &str,
        parameters: &[Variable],
    ) -> Result<(), String> {
        let title: String = name.split('_').map(capitalised).collect();
        let _ = writeln!(
            text,
            "/// The arguments of the kernel `{name}`.\n#[derive(Clone, Copy, Debug)]\npub struct {title} {{"
        );
        self.write_fields(text, file, parameters)?;
        let pointers: Vec<_> = parameters
            .iter()
            .map(|p| format!("std::ptr::from_ref(&self.{}).cast_mut().cast()", p.name))
            .collect();
        let _ = writeln!(
            text,
            "}}\nimpl crate::device::Kernel for {title} {{\n    const NAME: &'static str = {name:?};\n    fn arguments(&self) -> Vec<*mut std::ffi::c_void> {{\n        vec![{}]\n    }}\n}}",
            pointers.join(", ")
        );
        Ok(())
    }
}

impl File {
    /// Its module in Rust.
    fn path(&self) -> String {
        format!("crate::kernels::{}", self.module.join("::"))
    }
}

fn capitalised(word: &str) -> String {
    let (first, rest) = word.split_at(1);
    first.to_uppercase() + rest
}
