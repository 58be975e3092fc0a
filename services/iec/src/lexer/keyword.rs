//! The reserved words. Their case does not matter.

macro_rules! keywords {
    ($($name:ident = $text:literal),* $(,)?) => {
        /// A reserved word.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        pub enum Keyword { $($name),* }

        impl Keyword {
            /// In capitals.
            pub const fn text(self) -> &'static str {
                match self { $(Self::$name => $text),* }
            }
        }

        /// In order of their text, for the binary search.
        const TABLE: &[(&str, Keyword)] = &[$(($text, Keyword::$name)),*];
    };
}

// Sorted by text (tested).
keywords! {
    Abstract = "ABSTRACT",
    Action = "ACTION",
    And = "AND",
    AndThen = "AND_THEN",
    Array = "ARRAY",
    At = "AT",
    By = "BY",
    Case = "CASE",
    Class = "CLASS",
    Configuration = "CONFIGURATION",
    Constant = "CONSTANT",
    Continue = "CONTINUE",
    Do = "DO",
    Else = "ELSE",
    Elsif = "ELSIF",
    EndAction = "END_ACTION",
    EndCase = "END_CASE",
    EndClass = "END_CLASS",
    EndConfiguration = "END_CONFIGURATION",
    EndFor = "END_FOR",
    EndFunction = "END_FUNCTION",
    EndFunctionBlock = "END_FUNCTION_BLOCK",
    EndIf = "END_IF",
    EndInterface = "END_INTERFACE",
    EndMethod = "END_METHOD",
    EndNamespace = "END_NAMESPACE",
    EndProgram = "END_PROGRAM",
    EndRepeat = "END_REPEAT",
    EndResource = "END_RESOURCE",
    EndStep = "END_STEP",
    EndStruct = "END_STRUCT",
    EndTransition = "END_TRANSITION",
    EndType = "END_TYPE",
    EndVar = "END_VAR",
    EndWhile = "END_WHILE",
    Exit = "EXIT",
    Extends = "EXTENDS",
    False = "FALSE",
    For = "FOR",
    Function = "FUNCTION",
    FunctionBlock = "FUNCTION_BLOCK",
    FEdge = "F_EDGE",
    If = "IF",
    Implements = "IMPLEMENTS",
    InitialStep = "INITIAL_STEP",
    Interface = "INTERFACE",
    Method = "METHOD",
    Mod = "MOD",
    Namespace = "NAMESPACE",
    NonRetain = "NON_RETAIN",
    Not = "NOT",
    Null = "NULL",
    Of = "OF",
    Or = "OR",
    OrElse = "OR_ELSE",
    Overlap = "OVERLAP",
    Program = "PROGRAM",
    RefTo = "REF_TO",
    Repeat = "REPEAT",
    Resource = "RESOURCE",
    Retain = "RETAIN",
    Return = "RETURN",
    REdge = "R_EDGE",
    Step = "STEP",
    Struct = "STRUCT",
    Super = "SUPER",
    Task = "TASK",
    Then = "THEN",
    This = "THIS",
    To = "TO",
    Transition = "TRANSITION",
    True = "TRUE",
    Type = "TYPE",
    Until = "UNTIL",
    Using = "USING",
    Var = "VAR",
    VarAccess = "VAR_ACCESS",
    VarConfig = "VAR_CONFIG",
    VarExternal = "VAR_EXTERNAL",
    VarGlobal = "VAR_GLOBAL",
    VarInput = "VAR_INPUT",
    VarInOut = "VAR_IN_OUT",
    VarOutput = "VAR_OUTPUT",
    VarTemp = "VAR_TEMP",
    While = "WHILE",
    With = "WITH",
    Xor = "XOR",
}

const LONGEST: usize = 18;

/// The keyword with this spelling, if it is one.
pub(super) fn lookup(word: &str) -> Option<Keyword> {
    if word.len() > LONGEST {
        return None;
    }
    let mut upper = [0_u8; LONGEST];
    for (to, from) in upper.iter_mut().zip(word.bytes()) {
        *to = from.to_ascii_uppercase();
    }
    let upper = &upper[..word.len()];
    TABLE.binary_search_by(|(text, _)| text.as_bytes().cmp(upper)).ok().map(|i| TABLE[i].1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn table_is_sorted_and_complete() {
        assert!(TABLE.windows(2).all(|w| w[0].0 < w[1].0), "sort the table");
        assert!(TABLE.iter().all(|(t, _)| t.len() <= LONGEST));
        for (text, k) in TABLE {
            assert_eq!(lookup(text), Some(*k));
            assert_eq!(lookup(&text.to_ascii_lowercase()), Some(*k));
        }
        assert_eq!(lookup("ENDIF"), None);
        assert_eq!(lookup("a_very_long_name_that_is_no_keyword"), None);
    }
}
