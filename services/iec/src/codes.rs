//! Every code a diagnostic can have: what it means, what to do, a program that gets it and one that does not.
//!
//! `E01xx` text, `E02xx` syntax, `E03xx` declarations and names, `E04xx` types and values, `E05xx` calls, `E06xx`
//! addresses, `E07xx` configuration, `E08xx` limits, `E09xx` not supported, `W0xxx` warnings.

/// A code of the table.
#[derive(Debug, Clone, Copy)]
pub struct Code {
    pub id: &'static str,
    pub title: &'static str,
    pub cause: &'static str,
    pub remedy: &'static str,
    /// A source that gets the code; empty where the cause lies outside of the sources.
    pub bad: &'static str,
    /// The same put right.
    pub good: &'static str,
}

/// The entry of this code.
pub fn lookup(id: &str) -> Option<&'static Code> {
    CODES.iter().find(|c| c.id.eq_ignore_ascii_case(id))
}

macro_rules! codes {
    ($($id:literal $title:literal
       cause $cause:literal
       remedy $remedy:literal
       bad $bad:literal
       good $good:literal;)*) => {
        /// The table, in order of the codes.
        pub const CODES: &[Code] = &[
            $(Code { id: $id, title: $title, cause: $cause, remedy: $remedy, bad: $bad, good: $good },)*
        ];
    };
}

codes! {
"E0101" "character that does not belong here"
    cause "A character or an unclosed text that is no part of the language."
    remedy "Remove it; close texts on their line; write names in ASCII."
    bad "PROGRAM p VAR x : INT; END_VAR x := 1 + 2 !; END_PROGRAM"
    good "PROGRAM p VAR x : INT; END_VAR x := 1 + 2; END_PROGRAM";
"E0102" "comment is never closed"
    cause "`(*` or `/*` without its end. Comments nest, so every inner one needs its own end."
    remedy "Add `*)`."
    bad "PROGRAM p (* (* inner *) END_PROGRAM"
    good "PROGRAM p (* (* inner *) *) END_PROGRAM";
"E0103" "literal is not well formed"
    cause "Digits that do not belong to the base, a duration without unit, an underscore in the wrong place."
    remedy "Correct the literal."
    bad "PROGRAM p VAR t : TIME := T#5; END_VAR END_PROGRAM"
    good "PROGRAM p VAR t : TIME := T#5s; END_VAR END_PROGRAM";
"E0104" "literal is too large"
    cause "The value fits not even the largest type."
    remedy "Use a smaller value."
    bad "PROGRAM p VAR x : ULINT := 99999999999999999999; END_VAR END_PROGRAM"
    good "PROGRAM p VAR x : ULINT := 9999999999999999999; END_VAR END_PROGRAM";
"E0201" "something else is expected here"
    cause "The text does not follow the grammar."
    remedy "See what is expected."
    bad "PROGRAM p VAR x : INT; END_VAR x := 1 + ; END_PROGRAM"
    good "PROGRAM p VAR x : INT; END_VAR x := 1 + 1; END_PROGRAM";
"E0202" "`;` is missing"
    cause "Statements and declarations end with a semicolon."
    remedy "Add it."
    bad "PROGRAM p VAR x : INT; END_VAR x := 1 x := 2; END_PROGRAM"
    good "PROGRAM p VAR x : INT; END_VAR x := 1; x := 2; END_PROGRAM";
"E0203" "reserved name"
    cause "A keyword, a type or a standard function is used as a name."
    remedy "Choose another name."
    bad "PROGRAM p VAR to : INT; END_VAR END_PROGRAM"
    good "PROGRAM p VAR till : INT; END_VAR END_PROGRAM";
"E0204" "underscores in a name"
    cause "The standard forbids two underscores in a row and one at the end."
    remedy "Rename."
    bad "PROGRAM p VAR a__b : INT; END_VAR END_PROGRAM"
    good "PROGRAM p VAR a_b : INT; END_VAR END_PROGRAM";
"E0205" "`=` instead of `:=`"
    cause "`=` compares, `:=` assigns."
    remedy "Write `:=`."
    bad "PROGRAM p VAR x : INT; END_VAR x = 1; END_PROGRAM"
    good "PROGRAM p VAR x : INT; END_VAR x := 1; END_PROGRAM";
"E0206" "keyword in the wrong place"
    cause "A keyword that starts no statement, or that closes nothing here."
    remedy "Remove it or complete the construct before it."
    bad "PROGRAM p VAR x : INT; END_VAR THEN x := 1; END_PROGRAM"
    good "PROGRAM p VAR x : INT; END_VAR x := 1; END_PROGRAM";
"E0207" "a construct is not closed"
    cause "END_IF, END_VAR, END_PROGRAM or the like is missing."
    remedy "Add it; the second place shows what is open."
    bad "PROGRAM p VAR x : INT; END_VAR IF x > 1 THEN x := 0; END_PROGRAM"
    good "PROGRAM p VAR x : INT; END_VAR IF x > 1 THEN x := 0; END_IF; END_PROGRAM";
"E0301" "declared twice"
    cause "Two things of one scope have the same name up to case."
    remedy "Rename one."
    bad "PROGRAM p VAR level, Level : INT; END_VAR END_PROGRAM"
    good "PROGRAM p VAR level, level_max : INT; END_VAR END_PROGRAM";
"E0302" "unknown name, or not a constant"
    cause "The variable is not declared, or a constant is needed where a variable stands."
    remedy "Declare it; in bounds, labels and initial values use constants."
    bad "PROGRAM p VAR count : INT; END_VAR cuont := 1; END_PROGRAM"
    good "PROGRAM p VAR count : INT; END_VAR count := 1; END_PROGRAM";
"E0303" "unknown type"
    cause "There is no type or function block of this name."
    remedy "Declare it or correct the name."
    bad "PROGRAM p VAR x : INTT; END_VAR END_PROGRAM"
    good "PROGRAM p VAR x : INT; END_VAR END_PROGRAM";
"E0304" "a type contains itself"
    cause "An instance inside itself would need endless memory."
    remedy "Use VAR_IN_OUT."
    bad "FUNCTION_BLOCK a VAR x : a; END_VAR END_FUNCTION_BLOCK PROGRAM p END_PROGRAM"
    good "FUNCTION_BLOCK a VAR x : INT; END_VAR END_FUNCTION_BLOCK PROGRAM p END_PROGRAM";
"E0305" "section not allowed here"
    cause "For example RETAIN in a FUNCTION, VAR_GLOBAL in a PROGRAM, CONSTANT on inputs."
    remedy "Move the declaration."
    bad "PROGRAM p VAR_GLOBAL g : INT; END_VAR END_PROGRAM"
    good "VAR_GLOBAL g : INT; END_VAR PROGRAM p END_PROGRAM";
"E0306" "cannot be assigned"
    cause "Constants, outputs of instances, and what is no variable."
    remedy "Assign something else."
    bad "PROGRAM p VAR CONSTANT k : INT := 1; END_VAR k := 2; END_PROGRAM"
    good "PROGRAM p VAR k : INT := 1; END_VAR k := 2; END_PROGRAM";
"E0307" "VAR_EXTERNAL without its VAR_GLOBAL"
    cause "There is no global variable of this name, or it has another type."
    remedy "Declare it, or give the stack file a `symbol`."
    bad "PROGRAM p VAR_EXTERNAL g : INT; END_VAR END_PROGRAM"
    good "VAR_GLOBAL g : INT; END_VAR PROGRAM p VAR_EXTERNAL g : INT; END_VAR g := 1; END_PROGRAM";
"E0308" "CONSTANT without value"
    cause "A constant is its value."
    remedy "Add `:= value`."
    bad "PROGRAM p VAR CONSTANT k : INT; END_VAR END_PROGRAM"
    good "PROGRAM p VAR CONSTANT k : INT := 3; END_VAR END_PROGRAM";
"E0309" "no such member"
    cause "The structure or block has no member of this name, or it cannot be reached from outside."
    remedy "From outside only VAR_INPUT and VAR_OUTPUT can be reached."
    bad "PROGRAM p VAR t : TON; b : BOOL; END_VAR b := t.running; END_PROGRAM"
    good "PROGRAM p VAR t : TON; b : BOOL; END_VAR b := t.Q; END_PROGRAM";
"E0310" "initial value not allowed"
    cause "VAR_EXTERNAL and VAR_IN_OUT refer to a variable that has its own."
    remedy "Remove it."
    bad "VAR_GLOBAL g : INT; END_VAR PROGRAM p VAR_EXTERNAL g : INT := 1; END_VAR END_PROGRAM"
    good "VAR_GLOBAL g : INT := 1; END_VAR PROGRAM p VAR_EXTERNAL g : INT; END_VAR END_PROGRAM";
"E0311" "instance not allowed here"
    cause "Function blocks keep state: they cannot live in functions, VAR_TEMP or inputs."
    remedy "Declare it in VAR of a PROGRAM or FUNCTION_BLOCK; pass it by VAR_IN_OUT."
    bad "FUNCTION f : BOOL VAR t : TON; END_VAR f := t.Q; END_FUNCTION PROGRAM p END_PROGRAM"
    good "FUNCTION f : BOOL VAR_IN_OUT t : TON; END_VAR f := t.Q; END_FUNCTION PROGRAM p END_PROGRAM";
"E0312" "ambiguous enumeration value"
    cause "Two enumerations have a value of this name."
    remedy "Write Type#value."
    bad "TYPE a : (on, off); b : (on, idle); END_TYPE PROGRAM p VAR x : a; END_VAR x := on; END_PROGRAM"
    good "TYPE a : (on, off); b : (on, idle); END_TYPE PROGRAM p VAR x : a; END_VAR x := a#on; END_PROGRAM";
"E0401" "wrong type"
    cause "The value has another type and does not widen to the one needed."
    remedy "Convert with an X_TO_Y function; conversions that may lose something are never made silently."
    bad "PROGRAM p VAR i : INT; d : DINT; END_VAR i := d; END_PROGRAM"
    good "PROGRAM p VAR i : INT; d : DINT; END_VAR i := DINT_TO_INT(d); END_PROGRAM";
"E0402" "operator cannot take this operand"
    cause "For example arithmetic on WORD, AND on INT, NOT on a number."
    remedy "Convert the operand."
    bad "PROGRAM p VAR w : WORD; END_VAR w := w + w; END_PROGRAM"
    good "PROGRAM p VAR w : WORD; END_VAR w := w OR w; END_PROGRAM";
"E0403" "operands have no common type"
    cause "No type holds all values of both."
    remedy "Convert one side."
    bad "PROGRAM p VAR u : ULINT; i : INT; b : BOOL; END_VAR b := u > i; END_PROGRAM"
    good "PROGRAM p VAR u : ULINT; i : INT; b : BOOL; END_VAR b := u > INT_TO_ULINT(i); END_PROGRAM";
"E0404" "constant does not fit"
    cause "The constant is outside of the range of the type."
    remedy "Use a larger type or another value."
    bad "PROGRAM p VAR s : SINT := 200; END_VAR END_PROGRAM"
    good "PROGRAM p VAR s : USINT := 200; END_VAR END_PROGRAM";
"E0405" "division by the constant 0"
    cause "It would fault in every scan."
    remedy "Correct the divisor."
    bad "PROGRAM p VAR x : INT; END_VAR x := x / 0; END_PROGRAM"
    good "PROGRAM p VAR x : INT; END_VAR x := x / 10; END_PROGRAM";
"E0406" "constant index out of bounds"
    cause "The array has no such element."
    remedy "Correct the index or the bounds."
    bad "PROGRAM p VAR a : ARRAY [0..9] OF INT; END_VAR a[10] := 1; END_PROGRAM"
    good "PROGRAM p VAR a : ARRAY [0..9] OF INT; END_VAR a[9] := 1; END_PROGRAM";
"E0407" "bounds are no range"
    cause "The lower bound is above the upper one, or a bound does not fit."
    remedy "Lower bound first."
    bad "PROGRAM p VAR a : ARRAY [9..0] OF INT; END_VAR END_PROGRAM"
    good "PROGRAM p VAR a : ARRAY [0..9] OF INT; END_VAR END_PROGRAM";
"E0408" "initial value of the wrong form"
    cause "Arrays take a list of at most their length, structures and instances take members by name."
    remedy "Write [1, 2, 3(0)] or (a := 1, b := 2)."
    bad "PROGRAM p VAR a : ARRAY [0..1] OF INT := [1, 2, 3]; END_VAR END_PROGRAM"
    good "PROGRAM p VAR a : ARRAY [0..2] OF INT := [1, 2, 3]; END_VAR END_PROGRAM";
"E0409" "wrong subscripts"
    cause "The variable is no array, or has another number of dimensions."
    remedy "Give one subscript for each dimension."
    bad "PROGRAM p VAR a : ARRAY [0..1, 0..1] OF INT; END_VAR a[0] := 1; END_PROGRAM"
    good "PROGRAM p VAR a : ARRAY [0..1, 0..1] OF INT; END_VAR a[0, 1] := 1; END_PROGRAM";
"E0410" "EXIT or CONTINUE outside of a loop"
    cause "There is no loop to leave."
    remedy "Use RETURN to leave the POU."
    bad "PROGRAM p EXIT; END_PROGRAM"
    good "PROGRAM p RETURN; END_PROGRAM";
"E0411" "FOR with BY 0"
    cause "The loop would never end."
    remedy "Give another step."
    bad "PROGRAM p VAR i : INT; END_VAR FOR i := 1 TO 2 BY 0 DO END_FOR; END_PROGRAM"
    good "PROGRAM p VAR i : INT; END_VAR FOR i := 1 TO 2 BY 1 DO END_FOR; END_PROGRAM";
"E0501" "wrong number of arguments"
    cause "A positional call gives every input, in order."
    remedy "Add or remove arguments, or give them by name."
    bad "PROGRAM p VAR x : REAL; END_VAR x := SIN(x, x); END_PROGRAM"
    good "PROGRAM p VAR x : REAL; END_VAR x := SIN(x); END_PROGRAM";
"E0502" "unknown parameter"
    cause "The function, block or task has no parameter of this name."
    remedy "Inputs are given with `:=`, outputs taken with `=>`."
    bad "PROGRAM p VAR t : TON; END_VAR t(IN := TRUE, TP := T#1s); END_PROGRAM"
    good "PROGRAM p VAR t : TON; END_VAR t(IN := TRUE, PT := T#1s); END_PROGRAM";
"E0503" "parameter given twice"
    cause "One parameter, two values."
    remedy "Remove one."
    bad "PROGRAM p VAR t : TON; END_VAR t(IN := TRUE, IN := FALSE); END_PROGRAM"
    good "PROGRAM p VAR t : TON; END_VAR t(IN := TRUE); END_PROGRAM";
"E0504" "names and positions mixed"
    cause "Arguments are given all by name or all by position."
    remedy "Name all of them."
    bad "PROGRAM p VAR t : TON; END_VAR t(TRUE, PT := T#1s); END_PROGRAM"
    good "PROGRAM p VAR t : TON; END_VAR t(TRUE, T#1s); END_PROGRAM";
"E0505" "call has no value"
    cause "Calls of function blocks and of functions without result are statements."
    remedy "Call it first, then read its outputs."
    bad "PROGRAM p VAR t : TON; b : BOOL; END_VAR b := t(IN := TRUE); END_PROGRAM"
    good "PROGRAM p VAR t : TON; b : BOOL; END_VAR t(IN := TRUE); b := t.Q; END_PROGRAM";
"E0506" "cannot be called"
    cause "There is no function or instance of this name; block types and programs are not called."
    remedy "Declare an instance, or correct the name."
    bad "PROGRAM p VAR x : REAL; END_VAR x := SINN(x); END_PROGRAM"
    good "PROGRAM p VAR x : REAL; END_VAR x := SIN(x); END_PROGRAM";
"E0507" "parameter must be given"
    cause "VAR_IN_OUT refers to a variable in every call; arrays and structures have no default."
    remedy "Give it."
    bad "FUNCTION_BLOCK f VAR_IN_OUT x : INT; END_VAR x := x + 1; END_FUNCTION_BLOCK PROGRAM p VAR a : f; END_VAR a(); END_PROGRAM"
    good "FUNCTION_BLOCK f VAR_IN_OUT x : INT; END_VAR x := x + 1; END_FUNCTION_BLOCK PROGRAM p VAR a : f; y : INT; END_VAR a(x := y); END_PROGRAM";
"E0508" "cannot be referred to"
    cause "VAR_IN_OUT needs a variable with an address of its own: no constant, no located bit."
    remedy "Copy it to a variable first."
    bad "FUNCTION_BLOCK f VAR_IN_OUT x : BOOL; END_VAR x := TRUE; END_FUNCTION_BLOCK PROGRAM p VAR a : f; q AT %QX0.0 : BOOL; END_VAR a(x := q); END_PROGRAM"
    good "FUNCTION_BLOCK f VAR_IN_OUT x : BOOL; END_VAR x := TRUE; END_FUNCTION_BLOCK PROGRAM p VAR a : f; q : BOOL; END_VAR a(x := q); END_PROGRAM";
"E0509" "recursion"
    cause "A POU calls itself, directly or by way of others. The standard forbids it, and so the stack's depth is known."
    remedy "Use a loop."
    bad "FUNCTION f : INT VAR_INPUT n : INT; END_VAR f := f(n - 1); END_FUNCTION PROGRAM p VAR x : INT; END_VAR x := f(3); END_PROGRAM"
    good "FUNCTION f : INT VAR_INPUT n : INT; END_VAR f := n - 1; END_FUNCTION PROGRAM p VAR x : INT; END_VAR x := f(3); END_PROGRAM";
"E0601" "not an address"
    cause "An address is %I, %Q or %M, a size X, B, W, D or L, and a number; a byte has the bits 0 to 7."
    remedy "The message names the address that may be meant."
    bad "PROGRAM p VAR b AT %IX0.8 : BOOL; END_VAR END_PROGRAM"
    good "PROGRAM p VAR b AT %IX1.0 : BOOL; END_VAR END_PROGRAM";
"E0602" "address outside of its area"
    cause "The area is smaller."
    remedy "Use a lower address, or enlarge the area in the stack file."
    bad "PROGRAM p VAR b AT %IB5000 : BYTE; END_VAR END_PROGRAM"
    good "PROGRAM p VAR b AT %IB50 : BYTE; END_VAR END_PROGRAM";
"E0603" "type does not fit the address"
    cause "BOOL needs X, one byte B, two W, four D, eight L; TIME also takes D as 32-bit milliseconds."
    remedy "Change the type or the size letter."
    bad "PROGRAM p VAR b AT %IW0 : BYTE; END_VAR END_PROGRAM"
    good "PROGRAM p VAR b AT %IW0 : WORD; END_VAR END_PROGRAM";
"E0604" "symbol of the stack file is wrong"
    cause "Its name, type or address is wrong, or the sources declare the same name."
    remedy "Correct the stack file, or remove the declaration."
    bad ""
    good "PROGRAM p END_PROGRAM";
"E0605" "AT not allowed here"
    cause "Located variables stand in VAR of programs and function blocks and in VAR_GLOBAL, without RETAIN or CONSTANT."
    remedy "Move the variable."
    bad "PROGRAM p VAR_OUTPUT b AT %QX0.0 : BOOL; END_VAR END_PROGRAM"
    good "PROGRAM p VAR b AT %QX0.0 : BOOL; END_VAR END_PROGRAM";
"E0701" "more than one RESOURCE"
    cause "One plc service runs one resource."
    remedy "Use a plc service for each resource."
    bad "PROGRAM p END_PROGRAM CONFIGURATION c RESOURCE a ON x PROGRAM i : p; END_RESOURCE RESOURCE b ON x PROGRAM j : p; END_RESOURCE END_CONFIGURATION"
    good "PROGRAM p END_PROGRAM CONFIGURATION c RESOURCE a ON x PROGRAM i : p; PROGRAM j : p; END_RESOURCE END_CONFIGURATION";
"E0702" "nothing to run"
    cause "There is no PROGRAM, or no instance of one."
    remedy "Add a PROGRAM, or an instance to the RESOURCE."
    bad "FUNCTION f : INT f := 1; END_FUNCTION"
    good "FUNCTION f : INT f := 1; END_FUNCTION PROGRAM p VAR x : INT; END_VAR x := f(); END_PROGRAM";
"E0703" "`cycle` and TASK"
    cause "`cycle` in the stack file makes the one task of programs that declare none."
    remedy "Remove `cycle`, or the TASK."
    bad ""
    good "PROGRAM p END_PROGRAM CONFIGURATION c RESOURCE r ON x TASK t(INTERVAL := T#10ms); PROGRAM i WITH t : p; END_RESOURCE END_CONFIGURATION";
"E0704" "unknown PROGRAM or TASK"
    cause "The RESOURCE names something that is not there."
    remedy "Correct the name."
    bad "PROGRAM p END_PROGRAM CONFIGURATION c RESOURCE r ON x TASK t(INTERVAL := T#10ms); PROGRAM i WITH u : p; END_RESOURCE END_CONFIGURATION"
    good "PROGRAM p END_PROGRAM CONFIGURATION c RESOURCE r ON x TASK t(INTERVAL := T#10ms); PROGRAM i WITH t : p; END_RESOURCE END_CONFIGURATION";
"E0705" "parameter of a TASK is wrong"
    cause "INTERVAL is a constant duration, PRIORITY a constant from 0, SINGLE a global BOOL."
    remedy "Correct it."
    bad "PROGRAM p END_PROGRAM CONFIGURATION c RESOURCE r ON x TASK t(INTERVAL := 10); PROGRAM i WITH t : p; END_RESOURCE END_CONFIGURATION"
    good "PROGRAM p END_PROGRAM CONFIGURATION c RESOURCE r ON x TASK t(INTERVAL := T#10ms); PROGRAM i WITH t : p; END_RESOURCE END_CONFIGURATION";
"E0801" "nesting or count over its limit"
    cause "Expressions, statements, comments, types and lists have limits (see the table of limits)."
    remedy "Split it."
    bad "PROGRAM p VAR a : ARRAY [0..1,0..1,0..1,0..1,0..1,0..1,0..1] OF INT; END_VAR END_PROGRAM"
    good "PROGRAM p VAR a : ARRAY [0..1,0..1,0..1,0..1,0..1,0..1] OF INT; END_VAR END_PROGRAM";
"E0802" "name is too long"
    cause "Names have at most 128 characters."
    remedy "Shorten it."
    bad "PROGRAM aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa END_PROGRAM"
    good "PROGRAM a END_PROGRAM";
"E0803" "too many statements, variables, symbols or tasks"
    cause "The program is larger than the compiler takes (see the table of limits)."
    remedy "Use arrays; split the program."
    bad ""
    good "PROGRAM p END_PROGRAM";
"E0804" "image area is too large"
    cause "Areas of the image have at most 64 KiB."
    remedy "Make it smaller in the stack file."
    bad ""
    good "PROGRAM p END_PROGRAM";
"E0805" "too much memory"
    cause "An array, a structure, an instance or the whole program is too large."
    remedy "Make it smaller; the limit for all is 16 MiB."
    bad "PROGRAM p VAR a : ARRAY [0..9999999] OF LINT; END_VAR END_PROGRAM"
    good "PROGRAM p VAR a : ARRAY [0..9999] OF LINT; END_VAR END_PROGRAM";
"E0806" "too much RETAIN"
    cause "RETAIN variables need more than `retain_max` bytes (64 KiB)."
    remedy "Keep fewer variables."
    bad "PROGRAM p VAR RETAIN a : ARRAY [0..9999] OF LINT; END_VAR END_PROGRAM"
    good "PROGRAM p VAR RETAIN a : ARRAY [0..999] OF LINT; END_VAR END_PROGRAM";
"E0807" "source files"
    cause "No source, too many, or one of more than 1 MiB."
    remedy "Split the file."
    bad ""
    good "PROGRAM p END_PROGRAM";
"E0901" "internal error"
    cause "The compiler contradicts itself."
    remedy "Please report it with the sources."
    bad ""
    good "PROGRAM p END_PROGRAM";
"E0902" "language is not supported yet"
    cause "Instruction List and Sequential Function Chart are not compiled yet."
    remedy "Write Structured Text."
    bad "PROGRAM p VAR x : INT; END_VAR LD x ADD 1 ST x END_PROGRAM"
    good "PROGRAM p VAR x : INT; END_VAR x := x + 1; END_PROGRAM";
"E0903" "PLCopen XML is not supported yet"
    cause "The file is XML."
    remedy "Give Structured Text."
    bad "<?xml version=\"1.0\"?><project/>"
    good "PROGRAM p END_PROGRAM";
"E0904" "part of the language is not supported yet"
    cause "Classes, methods, namespaces, references, partial access (w.3), VAR_ACCESS, VAR_CONFIG, R_EDGE, EN/ENO in ST ..."
    remedy "The message names it and, where there is one, a way around."
    bad "PROGRAM p VAR w : WORD; b : BOOL; END_VAR b := w.3; END_PROGRAM"
    good "PROGRAM p VAR w : WORD; b : BOOL; END_VAR b := (w AND 16#0008) <> 0; END_PROGRAM";
"E0905" "this use is not supported yet"
    cause "For example functions that return structures, RETAIN inside a FUNCTION_BLOCK, parameters of program instances."
    remedy "The message names a way around."
    bad "FUNCTION_BLOCK f VAR RETAIN x : INT; END_VAR x := 1; END_FUNCTION_BLOCK PROGRAM p VAR a : f; END_VAR a(); END_PROGRAM"
    good "FUNCTION_BLOCK f VAR x : INT; END_VAR x := 1; END_FUNCTION_BLOCK PROGRAM p VAR RETAIN a : f; END_VAR a(); END_PROGRAM";
"E0906" "type or function is not supported yet"
    cause "STRING, WSTRING, dates, and the functions on them."
    remedy "None yet."
    bad "PROGRAM p VAR s : STRING; END_VAR END_PROGRAM"
    good "PROGRAM p VAR s : INT; END_VAR END_PROGRAM";
"W0101" "pragma is ignored"
    cause "Nothing here acts on `{...}`."
    remedy "Remove it, or leave it for other tools."
    bad "PROGRAM p {attribute 'x'} END_PROGRAM"
    good "PROGRAM p END_PROGRAM";
"W0103" "standard block is hidden"
    cause "A POU of the program has the name of a standard function block and takes its place."
    remedy "Rename it unless that is meant."
    bad "FUNCTION_BLOCK TON VAR_INPUT IN : BOOL; END_VAR END_FUNCTION_BLOCK PROGRAM p END_PROGRAM"
    good "FUNCTION_BLOCK MY_TON VAR_INPUT IN : BOOL; END_VAR END_FUNCTION_BLOCK PROGRAM p END_PROGRAM";
"W0201" "loop changes its control variable"
    cause "The standard forbids it. Here the changed value counts."
    remedy "Use WHILE."
    bad "PROGRAM p VAR i : INT; END_VAR FOR i := 1 TO 9 DO i := i + 1; END_FOR; END_PROGRAM"
    good "PROGRAM p VAR i, n : INT; END_VAR FOR i := 1 TO 9 DO n := n + 1; END_FOR; END_PROGRAM";
"W0202" "result is not used"
    cause "The function has no other effect than its result."
    remedy "Assign it."
    bad "PROGRAM p VAR x : INT; END_VAR ABS(x); END_PROGRAM"
    good "PROGRAM p VAR x : INT; END_VAR x := ABS(x); END_PROGRAM";
"W0203" "MOD by the constant 0"
    cause "The result is always 0, by the standard's definition."
    remedy "Correct the divisor."
    bad "PROGRAM p VAR x : INT; END_VAR x := x MOD 0; END_PROGRAM"
    good "PROGRAM p VAR x : INT; END_VAR x := x MOD 7; END_PROGRAM";
"W0204" "CASE labels overlap"
    cause "Two labels match one value; the first one counts."
    remedy "Remove one."
    bad "PROGRAM p VAR x : INT; END_VAR CASE x OF 1..5: x := 0; 3: x := 1; END_CASE; END_PROGRAM"
    good "PROGRAM p VAR x : INT; END_VAR CASE x OF 1..2: x := 0; 3: x := 1; END_CASE; END_PROGRAM";
"W0205" "own input is assigned"
    cause "The standard does not allow it; many compilers do."
    remedy "Copy the input to a VAR."
    bad "FUNCTION_BLOCK f VAR_INPUT x : INT; END_VAR x := 1; END_FUNCTION_BLOCK PROGRAM p END_PROGRAM"
    good "FUNCTION_BLOCK f VAR_INPUT x : INT; END_VAR VAR y : INT; END_VAR y := x; END_FUNCTION_BLOCK PROGRAM p END_PROGRAM";
"W0206" "function never assigns its result"
    cause "It returns the initial value of its type."
    remedy "Assign the function's name."
    bad "FUNCTION f : INT VAR x : INT; END_VAR x := 1; END_FUNCTION PROGRAM p END_PROGRAM"
    good "FUNCTION f : INT f := 1; END_FUNCTION PROGRAM p END_PROGRAM";
"W0207" "program is never run"
    cause "The RESOURCE has no instance of it."
    remedy "Add one, or remove the program."
    bad "PROGRAM p END_PROGRAM PROGRAM q END_PROGRAM CONFIGURATION c RESOURCE r ON x PROGRAM i : p; END_RESOURCE END_CONFIGURATION"
    good "PROGRAM p END_PROGRAM PROGRAM q END_PROGRAM CONFIGURATION c RESOURCE r ON x PROGRAM i : p; PROGRAM j : q; END_RESOURCE END_CONFIGURATION";
}
