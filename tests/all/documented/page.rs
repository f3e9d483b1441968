//! The fenced blocks and commands of a page.

/// A fenced block.
#[derive(Debug, PartialEq, Eq)]
pub struct Block {
    /// Line of its opening fence, counted from 1.
    pub line: usize,
    /// The words after the fence: the language and its argument.
    pub words: Vec<String>,
    /// Why its commands do not run in tests, `skip="REASON"` at the end of the fence.
    pub skip: Option<String>,
    /// Its content, without the indentation of the fence.
    pub text: String,
}

/// The fenced blocks of a page.
pub fn blocks(page: &str) -> Vec<Block> {
    let mut blocks = Vec::new();
    let mut lines = page.lines().enumerate();
    while let Some((number, opening)) = lines.next() {
        let Some(info) = opening.trim_start().strip_prefix("```") else { continue };
        let indent = opening.len() - opening.trim_start().len();
        let inside = lines.by_ref().map(|(_, line)| line);
        let inside = inside.take_while(|line| line.trim() != "```");
        let text = inside.map(|line| format!("{}\n", line.get(indent..).unwrap_or(""))).collect();
        let (info, skip) = match info.split_once(" skip=\"") {
            Some((info, reason)) => (info, reason.strip_suffix('"').map(str::to_owned)),
            None => (info, None),
        };
        let words = info.split_whitespace().map(str::to_owned).collect();
        blocks.push(Block { line: number + 1, words, skip, text });
    }
    blocks
}

/// The commands of a block: one per line; `\` at the end continues a line.
pub fn commands(text: &str) -> Vec<String> {
    let whole = text.replace("\\\n", " ");
    let lines = whole.lines().map(str::trim);
    lines.filter(|line| !line.is_empty() && !line.starts_with('#')).map(squeezed).collect()
}

/// Collapses blanks and removes a trailing comment.
fn squeezed(line: &str) -> String {
    let line = line.split_once("  #").map_or(line, |(command, _)| command);
    line.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[test]
fn blocks_and_commands_are_found() {
    let page = "a\n```toml pool.toml\nx = 1\n```\n1. b\n   ```sh skip=\"c d\"\n   # first\n   one \\\n     two   # why\n   three\n   ```\n";
    let found = blocks(page);
    let words: Vec<_> = found.iter().map(|block| block.words.join(" ")).collect();
    assert_eq!(words, ["toml pool.toml", "sh"]);
    assert_eq!((found[0].line, found[0].text.as_str()), (2, "x = 1\n"));
    assert_eq!(commands(&found[1].text), ["one two", "three"]);
    assert_eq!((&found[0].skip, found[1].skip.as_deref()), (&None, Some("c d")));
}
