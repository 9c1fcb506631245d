"""Compiling kernels in less than half the time: for a process that compiles and never calls what it compiled.

Numba makes each function that a kernel calls a kernel of its own: optimized, turned into code, loaded. The
child of `evlcp_sdk.kernels` only writes whole kernels into files. So what is called within one is handed to
it as it is, and all is optimized together, once. Besides, Numba writes much that LLVM removes again, each
line of it by the interpreter, and asks again and again what it knows: here it writes and asks less. What is
compiled computes the same: no operation on numbers changes, nor the order of any.

All this replaces parts of Numba that it promises nobody. `prepare` does so only for versions that it was
tried with; by another one kernels are compiled as Numba does by itself, in two to three times the time.
"""

import operator
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable
from contextlib import nullcontext
from functools import cache, partial
from typing import Any

import llvmlite.ir
import numba
import numpy as np
from llvmlite.binding import Linkage, ffi, parse_assembly
from llvmlite.ir import instructions
from numba import _dynfunc  # type: ignore[attr-defined]
from numba.core import (
    analysis,
    callconv,
    cgutils,
    codegen,
    cpu,
    errors,
    imputils,
    inline_closurecall,
    ir,
    lowering,
    postproc,
    transforms,
    typeinfer,
    types,
    utils,
)
from numba.core.base import BaseContext
from numba.core.compiler_machinery import PassManager, _pass_registry
from numba.core.registry import cpu_target
from numba.core.runtime.context import NRTContext
from numba.core.types.functions import BaseFunction
from numba.core.typing.context import Context as TypingContext
from numba.core.typing.templates import AbstractTemplate, signature
from numba.core.unsafe import eh
from numba.cpython import builtins, rangeobj, slicing
from numba.extending import intrinsic
from numba.np import arrayobj

__all__ = ["KeptKernel", "prepare"]

_TRIED = ("0.68.",)
"""Versions of Numba whose parts are known to be what is replaced here."""


class KeptKernel:
    """The kernel that is to be kept, with the functions in it: what is made ready for calls from Python.

    Attributes:
        place: Its module and name; None where there is none at the moment.
    """

    def __init__(self) -> None:
        self.place: tuple[str, str] | None = None

    def is_it(self, module: str, name: str) -> bool:
        """Whether a function is the kernel."""
        return self.place == (module, name)


def prepare(kept: KeptKernel) -> bool:
    """Replace what takes long; whether that was done. It is for good: no kernel can be called afterwards."""
    if not numba.__version__.startswith(_TRIED):
        return False
    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()
    _keep_calls_within(kept)
    _resolve_once()
    _look_up_once()
    _follow_lives_when_asked()
    _list_variables_quickly()
    _count_references_of_arrays_alone()
    tried: set[str] = set()
    _keep_values_of_variables(tried)
    _keep_structures_as_values()
    _call_in_few_words(tried)
    _count_down_ranges()
    _ask_for_room_once()
    _compare_in_place()
    _write_no_detours()
    _name_by_number()
    _run_passes_alone()
    _look_for_no_lists()
    # Whoever wants to know of LLVM's lock costs more than it.
    ffi.lib._lock._cblist.clear()
    return True


def _keep_calls_within(kept: KeptKernel) -> None:
    """Functions are linked as they are written, and only the kernel that is kept is optimized and emitted."""

    def simplify(self: Any, module: Any) -> None:
        module.data_layout = self._codegen._data_layout
        for function in module.functions:
            if not function.is_declaration:
                # As much as it takes to see which references need no counting.
                passes, builder = self._codegen._function_pass_manager(opt=1)
                passes.run(function, builder)

    def link(self: Any) -> None:
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalize_dynamic_globals()
        self._finalized = True

    def emitted(self: Any) -> tuple[str, str, tuple[bytes, bytes]]:
        self._ensure_finalized()
        # Another kernel may call it, too.
        module, self._final_module = self._final_module, self._final_module.clone()
        self._optimize_final_module_of(module)
        code = self._codegen._tm.emit_object(module)
        for function in module.functions:
            if not function.is_declaration and function.linkage == Linkage.external:
                function.linkage = "linkonce_odr"
        return self.name, "object", (code, module.as_bitcode())

    def parse(self: Any, written: Any) -> None:
        self._raise_if_finalized()
        module = parse_assembly(str(written))
        module.name = written.name
        module.verify()
        self.add_llvm_module(module)

    def optimize(self: Any, module: Any) -> None:
        cheap = {"loop_vectorize": False, "slp_vectorize": False, "opt": 0, "cost": "cheap"}
        for options in (cheap, {}):
            passes, builder = self._codegen._module_pass_manager(**options)
            passes.run(module, builder)

    def not_callable(_: Any, library: Any, description: Any, environment: Any) -> Any:
        name = description.qualname.split(".")[-1]
        return _dynfunc.make_function(description.lookup_module(), name, "", 0, environment, (library,))

    wrap = cpu.CPUContext.create_cpython_wrapper

    def wrap_kept(self: Any, library: Any, description: Any, *of: Any, **options: Any) -> None:
        if kept.is_it(description.modname, description.qualname):
            wrap(self, library, description, *of, **options)

    library: Any = codegen.JITCodeLibrary
    library.add_ir_module = parse
    library._optimize_functions = simplify
    library._optimize_final_module_of = optimize
    library.finalize = link
    library.serialize_using_object_code = emitted
    context: Any = cpu.CPUContext
    context.get_executable = not_callable
    context.create_cpython_wrapper = wrap_kept
    context.create_cfunc_wrapper = lambda *_, **__: None


def _resolve_once() -> None:
    """What a function of Numba's gives for types of arguments is worked out once, with all its overloads."""
    resolve = BaseFunction.get_call_type

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws:
            return resolve(self, context, args, kws)
        known = self.__dict__.setdefault("_evlcp_known", {})
        found = known.get(tuple(args))
        if found is None:
            found = known[tuple(args)] = resolve(self, context, args, kws)
        return found

    function: Any = BaseFunction
    function.get_call_type = get_call_type


def _look_up_once() -> None:
    """What says the same each time: signatures of Python functions, sizes of types, what passes rely on.

    What Numba can compile is looked through again only when there is more of it.
    """
    functions: Any = utils
    functions.pysignature = cache(functions.pysignature)
    measure, analyse = BaseContext.get_abi_sizeof, PassManager.dependency_analysis
    sizes: dict[str, int] = {}
    analyses: dict[tuple[Any, ...], Any] = {}

    def size(self: Any, kind: Any) -> int:
        name = str(kind)
        if name not in sizes:
            sizes[name] = measure(self, kind)
        return sizes[name]

    def relied_on(self: Any) -> Any:
        passes = tuple(one for one, _ in self.passes)
        if passes not in analyses:
            analyses[passes] = analyse(self)
        return analyses[passes]

    def when_more(refresh: Any) -> Any:
        def refreshed(self: Any) -> None:
            known = self._registries.items()
            count = sum(len(getattr(one, name)) for one, reader in known for name in reader.registry_items)
            if count != self.__dict__.get("_evlcp_count"):
                refresh(self)
                self._evlcp_count = count

        return refreshed

    context: Any = BaseContext
    context.get_abi_sizeof = size
    context.refresh = when_more(context.refresh)
    typing: Any = TypingContext
    typing.refresh = when_more(typing.refresh)
    manager: Any = PassManager
    manager.dependency_analysis = relied_on


def _follow_lives_when_asked() -> None:
    """Which variables live where is worked out for the pass that ends them, not after each that moves some.

    `VariableLifetime` works it out when it is asked for; what is left out is where generators are taken up.
    """
    follow = postproc.PostProcessor.run

    def run(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
        function = self.func_ir
        if function.is_generator:
            follow(self, emit_dels, extend_lifetimes)
            return
        function.blocks = transforms.canonicalize_cfg(function.blocks)
        function.variable_lifetime = postproc.VariableLifetime(function.blocks)
        function.generator_info = None
        if emit_dels:
            self._insert_var_dels(extend_lifetimes=extend_lifetimes)

    processor: Any = postproc.PostProcessor
    processor.run = run


def _list_variables_quickly() -> None:
    """The variables of instructions, asked for after each pass: plain types first, what is common first."""
    plain = {str, int, float, bool, type(None), ir.Loc}

    def of_all(values: Any) -> list[Any]:
        found: list[Any] = []
        for value in values:
            kind = type(value)
            if kind is ir.Var:
                found.append(value)
            elif kind not in plain:
                found += listed(None, value)
        return found

    def listed(_: Any, value: Any) -> list[Any]:
        if isinstance(value, ir.Var):
            return [value]
        if isinstance(value, ir.Inst):
            return value.list_vars()  # type: ignore[no-any-return]
        if isinstance(value, dict):
            return of_all(value.values())
        return of_all(value) if isinstance(value, list | tuple) else []

    def used_and_defined(blocks: Any) -> Any:
        used: dict[int, set[str]] = {offset: set() for offset in blocks}
        defined: dict[int, set[str]] = {offset: set() for offset in blocks}
        for offset, block in blocks.items():
            uses, defines = used[offset], defined[offset]
            for statement in block.body:
                if type(statement) in analysis.ir_extension_usedefs:
                    analysis.ir_extension_usedefs[type(statement)](statement, uses, defines)
                    continue
                names = {variable.name for variable in statement.list_vars()}
                if isinstance(statement, ir.Assign):
                    value, target = statement.value, statement.target.name
                    if target not in {variable.name for variable in of_all((value,))}:
                        defines.add(target)
                uses |= names - defines
        return analysis._use_defs_result(usemap=used, defmap=defined)

    instruction: Any = ir.Inst
    assignment: Any = ir.Assign
    expression: Any = ir.Expr
    instruction._rec_list_vars = listed
    assignment.list_vars = lambda self: of_all((self.value, self.target))
    expression.list_vars = lambda self: of_all(self._kws.values())
    analysis.compute_use_defs = used_and_defined


def _write_no_detours() -> None:
    """What was put into a structure is not taken from it again, nor twice; no index is times 1, or plus 0."""
    builder: Any = llvmlite.ir.IRBuilder
    extract, constant, insertion = builder.extract_value, llvmlite.ir.Constant, instructions.InsertValue

    def extract_value(self: Any, whole: Any, index: Any, name: str = "") -> Any:
        path = [index] if isinstance(index, int) else index
        if len(path) != 1:
            return extract(self, whole, index, name)
        at = path[0]
        while type(whole) is insertion and len(whole.indices) == 1:
            if whole.indices[0] == at:
                return whole.value
            whole = whole.aggregate
        taken = whole.__dict__.setdefault("_taken", {})
        before = taken.get(at)
        follows = self._anchor == len(self._block.instructions)
        if before is None or before.parent is not self._block or not follows:
            before = taken[at] = extract(self, whole, at, name)
        return before

    def without(neutral: int, operate: Any) -> Any:
        def operated(self: Any, one: Any, other: Any, name: str = "", flags: Any = ()) -> Any:
            for a, b in ((one, other), (other, one)):
                if type(a) is constant and a.constant == neutral and a.type == b.type:
                    return b
            return operate(self, one, other, name, flags)

        return operated

    fix = slicing.fix_index

    def fix_index(builder: Any, index: Any, size: Any) -> Any:
        known = type(index) is constant and isinstance(index.constant, int) and index.constant >= 0
        return index if known else fix(builder, index, size)

    builder.extract_value = extract_value
    builder.mul, builder.add = without(1, builder.mul), without(0, builder.add)
    slicing.fix_index = fix_index


@cache
def _holds_references(context: Any, kind: Any) -> bool:
    """Whether a value of a type is, or has, what references are counted of."""
    return bool(context.data_model_manager[kind].contains_nrt_meminfo())


def _count_references_of_arrays_alone() -> None:
    """Where references are counted, only what holds one is taken apart; a number that ends is left alone."""

    def counted(self: Any, builder: Any, kind: Any, value: Any) -> list[tuple[Any, Any]]:
        if not _holds_references(self._context, kind):
            return []
        model = self._context.data_model_manager[kind]
        found = [(kind, model.get_nrt_meminfo(builder, value))] if model.has_nrt_meminfo() else []
        for member, get in model.traverse(builder):
            if _holds_references(self._context, member):
                found += counted(self, builder, member, get(value))
        return found

    delete = lowering.Lower.delvar

    def end(self: Any, name: str) -> None:
        kind = self.typeof(name)
        if self._disable_sroa_like_opt or _holds_references(self.context, kind):
            delete(self, name)
            return
        if name not in self._blk_local_varmap:
            self._singly_assigned_vars.discard(name)
        self._alloca_var(name, kind)

    runtime: Any = NRTContext
    runtime.get_meminfos = counted
    lower: Any = lowering.Lower
    lower.delvar = end


def _keep_values_of_variables(functions_tried: set[str]) -> None:
    """A variable that is set in one place, which all its uses come after, is its value, no place in memory.

    Numba does so within a block. Where references are counted there is a place, too, to end what it has.
    """
    lower: Any = lowering.Lower
    allocate, load, store = lower._alloca_var, lower.loadvar, lower.storevar

    def find(self: Any) -> None:
        blocks, function = self.func_ir.blocks, self.func_ir.func_id
        self._singly_assigned_vars, self._blk_local_varmap = set(), {}
        self._set_once, self._values = set(), {}
        if function.is_generator or self._disable_sroa_like_opt:
            return
        known = analysis.compute_use_defs(blocks)
        set_in: dict[str, set[int]] = defaultdict(set)
        used_in: dict[str, set[int]] = defaultdict(set)
        for found, by_block in ((set_in, known.defmap), (used_in, known.usemap)):
            for label, names in by_block.items():
                for name in names:
                    found[name].add(label)
        times = Counter(one.target.name for block in blocks.values() for one in block.find_insts(ir.Assign))
        before = analysis.compute_cfg_from_blocks(blocks).dominators()
        tried = any(_is_of_exceptions(one) for block in blocks.values() for one in block.body)
        if tried:
            functions_tried.add(self.fndesc.llvm_func_name)
        in_memory = analysis.must_use_alloca(blocks)
        for name, labels in set_in.items():
            if times[name] != 1 or name in in_memory:
                continue
            (label,) = labels
            if not used_in[name]:
                self._singly_assigned_vars.add(name)
            elif not tried and all(label in before[use] and label < use for use in used_in[name]):
                self._set_once.add(name)

    def allocated(self: Any, name: str, kind: Any) -> None:
        if name not in self._set_once or _holds_references(self.context, kind):
            allocate(self, name, kind)

    def loaded(self: Any, name: str) -> Any:
        value = self._values.get(name)
        return load(self, name) if value is None else value

    def stored(self: Any, value: Any, name: str, argidx: Any = None) -> None:
        once, counted = name in self._set_once, _holds_references(self.context, self.typeof(name))
        if not once or counted:
            # Where nothing is counted, what was there is not looked at, as an argument's place is not.
            store(self, value, name, argidx if counted else 0)
        if once:
            self._values[name] = value

    lower._find_singly_assigned_variable = find
    lower._alloca_var, lower.loadvar, lower.storevar = allocated, loaded, stored


def _is_of_exceptions(statement: Any) -> bool:
    """Whether a function may go on where something was raised."""
    value = getattr(statement, "value", None)
    return isinstance(value, ir.Global) and value.value is eh.exception_check


def _keep_structures_as_values() -> None:
    """Arrays, ranges and what else is a structure are values, without a copy in memory for each time.

    Fields are set and taken as long as nobody sets one in a branch or asks for a place in memory; then the
    value is put there, where it was set, as this may be in a branch of what follows.
    """
    structure: Any = cgutils._StructProxy
    begin, load, store = structure.__init__, structure.__getitem__, structure.__setitem__
    refer = structure._make_refs

    def made(self: Any, context: Any, builder: Any, value: Any = None, ref: Any = None) -> None:
        if ref is not None or (value is None and type(self)._make_refs is not refer):
            begin(self, context, builder, value=value, ref=ref)
            return
        self._context, self._builder = context, builder
        self._datamodel = context.data_model_manager[self._fe_type]
        self._be_type = self._get_be_type(self._datamodel)
        if value is None:
            value = llvmlite.ir.Constant(self._be_type, None)
        if value.type != self._be_type:
            raise AssertionError(f"bad value type: expected {self._be_type}, got {value.type}")
        block, at = builder._block, builder._anchor
        self._read, self._behind = value, (block, block.instructions[at - 1] if at else None)

    def stored(self: Any) -> Any:
        builder, (block, last) = self._builder, self._behind
        here, at, before = builder._block, builder._anchor, len(builder._block.instructions)
        place = _place(builder, self._be_type)
        behind = [one for one in (last, place) if one is not None and one.parent is block]
        builder._block = block
        builder._anchor = max((block.instructions.index(one) + 1 for one in behind), default=0)
        builder.store(self._read, place)
        builder._block, builder._anchor = here, at + len(here.instructions) - before
        return place

    def attribute(self: Any, name: str) -> Any:
        if name in ("_value", "_outer_ref") and "_read" in self.__dict__:
            self._value = self._outer_ref = stored(self)
            del self._read, self._behind
            return self._value
        if name.startswith("_"):
            raise AttributeError(name)
        return self[self._datamodel.get_field_position(name)]

    def field(self: Any, index: int) -> Any:
        value = self.__dict__.get("_read")
        return load(self, index) if value is None else self._builder.extract_value(value, index)

    def set_field(self: Any, index: int, value: Any) -> None:
        whole, block = self.__dict__.get("_read"), self._builder._block
        if whole is None or self._behind[0] is not block or value.type != self._be_type.elements[index]:
            store(self, index, value)
            return
        self._read = self._builder.insert_value(whole, value, index)
        self._behind = block, self._read

    def whole(self: Any) -> Any:
        value = self.__dict__.get("_read")
        return self._builder.load(self._outer_ref) if value is None else value

    proxy: Any = cgutils.ValueStructProxy
    proxy.__init__, proxy.__getattr__, proxy._getvalue = made, attribute, whole
    proxy.__getitem__, proxy.__setitem__ = field, set_field

    make, arrays = arrayobj.make_array, {}

    def shape(self: Any) -> Any:
        if "_read" in self.__dict__:
            return field(self, self._datamodel.get_field_position("shape"))
        place, sizes = self._get_ptr_by_name("shape"), []
        for axis in range(self._fe_type.ndim):
            sizes.append(self._builder.load(cgutils.gep_inbounds(self._builder, place, 0, axis)))
            arrayobj.mark_positive(self._builder, sizes[-1])
        return cgutils.pack_array(self._builder, sizes) if sizes else attribute(self, "shape")

    def make_array(kind: Any) -> Any:
        if type(kind) is not types.Array:
            return make(kind)
        if kind not in arrays:
            arrays[kind] = type("Array", (cgutils.create_struct_proxy(kind),), {"shape": property(shape)})
        return arrays[kind]

    for module in [m for name, m in sys.modules.items() if name.startswith("numba.")]:
        if getattr(module, "make_array", None) is make:
            vars(module)["make_array"] = make_array


def _place(builder: Any, kind: Any) -> Any:
    """A place in memory for what is always put there before it is taken: it needs no zero."""
    with builder.goto_entry_block():
        return builder.alloca(kind)


class _Status:
    """What a call came back with: worked out where somebody asks."""

    def __init__(self, builder: Any, code: Any, told: Any, kind: Any) -> None:
        self.code = code
        self._builder, self._told = builder, told
        self._may_be_none = kind is types.none or isinstance(kind, types.Optional)

    def _is(self, how: str, code: Any) -> Any:
        return self._builder.icmp_signed(how, self.code, code)

    @property
    def excinfoptr(self) -> Any:
        return self._builder.load(self._told)

    @property
    def is_none(self) -> Any:
        return self._is("==", callconv.RETCODE_NONE)

    @property
    def is_error(self) -> Any:
        failed = self._is("!=", callconv.RETCODE_OK)
        return (
            self._builder.and_(failed, self._is("!=", callconv.RETCODE_NONE)) if self._may_be_none else failed
        )

    @property
    def is_ok(self) -> Any:
        return self._builder.not_(self.is_error)

    @property
    def is_python_exc(self) -> Any:
        return self._is("==", callconv.RETCODE_EXC)

    @property
    def is_stop_iteration(self) -> Any:
        return self._is("==", callconv.RETCODE_STOPIT)

    @property
    def is_user_exc(self) -> Any:
        return self._is(">=", callconv.RETCODE_USEREXC)


def _call_in_few_words(tried: set[str]) -> None:
    """What is called tells of errors where its caller does, so that a code is all that a call brings back.

    `tried` are the functions that may go on where something was raised.
    """
    convention: Any = callconv.CPUCallConv
    call, propagate = convention.call_function, convention.return_status_propagate
    telling = llvmlite.ir.PointerType(callconv.excinfo_ptr_t)

    def called(
        self: Any, builder: Any, callee: Any, kind: Any, kinds: Any, args: Any, attrs: Any = None
    ) -> tuple[Any, Any]:
        own = builder.function.args
        if attrs is not None or len(own) < 2 or own[1].type != telling:
            return call(self, builder, callee, kind, kinds, args, attrs)  # type: ignore[no-any-return]
        returned = self.get_return_type(kind).pointee
        place = _place(builder, returned)
        if kind is types.none or isinstance(kind, types.Optional):
            builder.store(cgutils.get_null_value(returned), place)
        args = self._get_arg_packer(kinds).as_arguments(builder, args)
        code = builder.call(callee, [place, own[1], *args])
        value = self.context.get_returned_value(builder, kind, builder.load(place))
        return _Status(builder, code, own[1], kind), value

    def passed_on(self: Any, builder: Any, status: Any) -> None:
        if type(status) is _Status and builder.function.name not in tried:
            self._return_errcode_raw(builder, status.code)
        else:
            propagate(self, builder, status)

    convention.call_function, convention.return_status_propagate = called, passed_on

    context: Any = BaseContext
    give, take = context.get_return_value, context.get_returned_value

    def same(self: Any, kind: Any) -> bool:
        model = self.data_model_manager[kind]
        return bool(model.get_return_type() == model.get_value_type())

    def given(self: Any, builder: Any, kind: Any, value: Any) -> Any:
        return value if same(self, kind) else give(self, builder, kind, value)

    def taken(self: Any, builder: Any, kind: Any, value: Any) -> Any:
        return value if same(self, kind) else take(self, builder, kind, value)

    context.get_return_value, context.get_returned_value = given, taken


def _count_down_ranges() -> None:
    """A range that goes by 1 or -1 needs no division to know how often, and each step of it no branch."""
    context = cpu_target.target_context

    def lower(kind: Any, iterator: Any) -> None:
        begin = context._defns["getiter"].find((kind,))

        def began(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            state = context.make_helper(builder, kind, args[0])
            start, stop, step = state.start, state.stop, state.step
            if type(step) is not llvmlite.ir.Constant or step.constant not in (1, -1):
                return begin(context, builder, signature, args)
            left = builder.sub(stop, start) if step.constant == 1 else builder.sub(start, stop)
            none = left.type(0)
            left = builder.select(builder.icmp_signed(">", left, none), left, none)
            found = context.make_helper(builder, iterator)
            found.iter, found.count = _place(builder, left.type), _place(builder, left.type)
            found.stop, found.step = stop, step
            builder.store(start, found.iter)
            builder.store(left, found.count)
            return found._getvalue()

        def followed(context: Any, builder: Any, _: Any, args: Any, result: Any) -> None:
            state = context.make_helper(builder, iterator, args[0])
            left, value = builder.load(state.count), builder.load(state.iter)
            result.set_valid(builder.icmp_signed(">", left, left.type(0)))
            result.yield_(value)
            builder.store(builder.sub(left, left.type(1), flags=["nsw"]), state.count)
            builder.store(builder.add(value, state.step), state.iter)

        following = imputils.iternext_impl(imputils.RefType.BORROWED)(followed)
        context.insert_func_defn([(began, "getiter", (kind,)), (following, "iternext", (iterator,))])

    for kinds in rangeobj.range_impl_map.values():
        lower(*kinds)


def _resolve_first(function: Any, resolve: Any, lower: Any, counts: Iterable[int]) -> None:
    """Lower calls of a function in place where `resolve` gives a type for those of its arguments."""
    context, typing = cpu_target.target_context, cpu_target.typing_context
    name = f"evlcp {function.__name__}"

    class InPlace(AbstractTemplate):
        key = name

        def generic(self, args: Any, kws: Any) -> Any:
            kind = None if kws else resolve(self.context, args)
            return None if kind is None else signature(kind, *args)

    found: Any = typing.resolve_value_type(function)
    found.templates = (InPlace, *found.templates)
    context.insert_func_defn([(lower, name, (types.Any,) * count) for count in counts])


def _ask_for_room_once() -> None:
    """Arrays are made where they are asked for: what is called gives memory, whatever is to be in it."""

    def memory(_: Any, array: Any) -> Any:
        def taken(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            found = context.make_helper(builder, signature.args[0], args[0]).meminfo
            return imputils.impl_ret_borrowed(context, builder, signature.return_type, found)

        return types.MemInfoPointer(types.voidptr)(array), taken

    memory_of: Any = intrinsic(memory)

    def room(shape: Any) -> Any:
        # By name, which leads to what Numba makes arrays by.
        return memory_of(np.empty(shape, dtype=np.uint8))

    of: Any = arrayobj

    def resolve(_: Any, args: Any) -> Any:
        if not 1 <= len(args) <= 2:
            return None
        axes, kind = of.ty_parse_shape(args[0]), types.float64
        if len(args) == 2 and not (isinstance(args[1], types.Function) and args[1].typing_key is float):
            kind = of.ty_parse_dtype(args[1])
        plain = isinstance(kind, types.Number | types.Boolean)
        return types.Array(kind, axes, "C") if axes and plain else None

    def made(zeros: bool, context: Any, builder: Any, wanted: Any, args: Any) -> Any:
        kind, of_shape = wanted.return_type, wanted.args[0]
        shape, kinds = args[:1], [of_shape]
        if hasattr(of_shape, "types"):
            kinds, shape = of_shape.types, cgutils.unpack_tuple(builder, args[0])
        sizes = [context.cast(builder, size, one, types.intp) for size, one in zip(shape, kinds, strict=True)]
        item = context.get_constant(types.intp, arrayobj.get_itemsize(context, kind))
        asked = types.MemInfoPointer(types.voidptr)(types.UniTuple(types.intp, kind.ndim + 1))
        meminfo = context.compile_internal(
            builder, room, asked, (cgutils.pack_array(builder, [*sizes, item]),)
        )
        data = context.nrt.meminfo_data(builder, meminfo)
        strides = [item]
        for size in reversed(sizes[1:]):
            strides.insert(0, builder.mul(strides[0], size))
        if zeros:
            cgutils.memset(builder, data, builder.mul(strides[0], sizes[0]), 0)
        array = context.make_helper(builder, kind)
        pointer = context.get_data_type(kind.dtype).as_pointer()
        arrayobj.populate_array(array, builder.bitcast(data, pointer), sizes, strides, item, meminfo)
        return array._getvalue()

    _resolve_first(np.empty, resolve, partial(made, False), (1, 2))
    _resolve_first(np.zeros, resolve, partial(made, True), (1, 2))


def _compare_in_place() -> None:
    """The greater and the less of numbers are chosen where they are asked for."""

    def resolve(context: Any, args: Any) -> Any:
        numbers = len(args) > 1 and all(isinstance(kind, types.Integer | types.Float) for kind in args)
        return context.unify_types(*args) if numbers else None

    def choose(better: Any) -> Any:
        def chosen(context: Any, builder: Any, wanted: Any, args: Any) -> Any:
            return builtins.do_minmax(context, builder, wanted.args, args, better)

        return chosen

    for function, better in ((max, operator.gt), (min, operator.lt)):
        _resolve_first(function, resolve, choose(better), (2, 3, 4))


def _name_by_number() -> None:
    """Instructions are named by numbers: nobody reads their names, so none is looked for among others."""

    def named(self: Any, _: str) -> None:
        scope = self.parent.scope
        scope.count = count = getattr(scope, "count", 0) + 1
        # Arguments and blocks have other names.
        self._name = f"~{count}"
        self._reference = f'%"~{count}"'

    def begin(
        self: Any, parent: Any, kind: Any, opname: str, operands: Any, name: str = "", flags: Any = ()
    ) -> None:
        self.parent, self.type, self.opname, self.operands = parent, kind, opname, operands
        self.flags, self.metadata = list(flags), {}
        named(self, name)

    instruction: Any = instructions.Instruction
    instruction.__init__, instruction._set_name = begin, named
    instruction.get_reference = lambda self: self._reference


def _run_passes_alone() -> None:
    """Passes run without what tells of them and of errors: what fails here the parent compiles again."""

    def run_pass(self: Any, _: int, one: Any, state: Any) -> None:
        one.analysis = self._analysis
        changed = [step(state) for step in (one.run_initialization, one.run_pass, one.run_finalizer)]
        if self._ENFORCING and _pass_registry.get(type(one)).mutates_CFG:
            if any(changed):
                postproc.PostProcessor(state.func_ir).run()
            else:
                state.func_ir.blocks = transforms.canonicalize_cfg(state.func_ir.blocks)

    nothing = nullcontext()
    for module in (errors, typeinfer, lowering):
        vars(module)["new_error_context"] = lambda *_, **__: nothing
    manager: Any = PassManager
    manager._runPass = run_pass
    fixer: Any = vars(errors)["WarningsFixer"]
    fixer.catch_warnings = lambda *_, **__: nothing


def _look_for_no_lists() -> None:
    """Where no list is built and no function made, none is looked for that could be put in its place."""
    closures: Any = inline_closurecall.InlineClosureCallPass
    lists: Any = inline_closurecall.RewriteArrayOfConsts
    inline, match = closures.run, lists.match

    def run(self: Any) -> None:
        if _has(self.func_ir, ("build_list", "make_function")):
            inline(self)

    def matches(self: Any, function: Any, block: Any, *of: Any) -> Any:
        return any(block.find_exprs("build_list")) and match(self, function, block, *of)

    closures.run, lists.match = run, matches


def _has(function: Any, operations: tuple[str, ...]) -> bool:
    """Whether there is such an expression in a function."""
    values = (getattr(one, "value", None) for block in function.blocks.values() for one in block.body)
    return any(type(value) is ir.Expr and value.op in operations for value in values)
