"""A graphics card that is none: it computes on the CPU, but takes no tensors of the CPU, as a card does not.

Wrappers around the CPU's tensors on the device that torch leaves open for others ("PrivateUse1"), so that autograd,
modules and optimisers treat it as a card. What it shows is that nothing on the way of --device cuda mixes tensors of
two devices, draws with the wrong generator, or hands a card's tensor to numpy. What it cannot show: a card's own
rounding, its memory, its speed.

A process that has made the device keeps it: tests run `card_cases.py` in a process of its own.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend  # pyright: ignore[reportPrivateUsage]

NAME = "card"
_setup_privateuseone_for_python_backend(NAME)
CARD = torch.device(NAME, 0)
CPU = torch.device("cpu")

aten = torch.ops.aten
COPIES = (aten._to_copy.default, aten.copy_.default)
INDEXING = (aten.index.Tensor, aten.index_put.default, aten.index_put_.default, aten._index_put_impl_.default)
INDICES = 1  # which argument of these may be on the CPU


class OnCard(torch.Tensor):
    """A tensor of the card; `held` are its numbers."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> "OnCard":
        like = {"dtype": held.dtype, "layout": held.layout, "device": CARD}
        made = torch.Tensor._make_wrapper_subclass(
            cls, held.size(), strides=held.stride(), storage_offset=held.storage_offset(), **like
        )
        made.held = held
        return made

    def __repr__(self, *, tensor_contents: Any = None) -> str:
        return f"OnCard({self.held!r})"

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, arguments: Any = (), named: Any = None) -> Any:
        return computed(operation, arguments, named or {})


def computed(operation: Any, arguments: tuple, named: dict) -> Any:
    """One operation of torch, on tensors of either device.

    Raises:
        RuntimeError: a card would refuse it, too.
    """
    wanted = named.get("device")
    goes_to_card = wanted is not None and torch.device(wanted).type == NAME
    on_card = any(isinstance(x, OnCard) for x in tree_leaves((arguments, named)))
    if goes_to_card:
        named = named | {"device": CPU}
    if on_card and operation not in COPIES:
        refuse_mixture(operation, arguments, named)
    if (goes_to_card or on_card) and operation not in COPIES:
        refuse_generator(operation, arguments, named)
    held, held_named = tree_map(lambda x: x.held if isinstance(x, OnCard) else x, (arguments, named))
    out = operation(*held, **held_named)
    if writes_first(operation):
        return arguments[0]
    stays = goes_to_card or (on_card and wanted is None)
    return tree_map(lambda x: OnCard(x) if stays and isinstance(x, Tensor) else x, out)


def writes_first(operation: Any) -> bool:
    """Whether the operation changes its first argument, and gives it back."""
    first = operation._schema.arguments[0].alias_info if operation._schema.arguments else None
    return first is not None and first.is_write and len(operation._schema.returns) == 1


def refuse_mixture(operation: Any, arguments: tuple, named: dict) -> None:
    """Beside a card's tensors only a number may be on the CPU, or what indexes them."""
    judged = [x for i, x in enumerate(arguments) if operation not in INDEXING or i != INDICES]
    tensors = [x for x in tree_leaves((judged, named)) if isinstance(x, Tensor)]
    strangers = [x for x in tensors if not isinstance(x, OnCard) and x.dim() > 0]
    if strangers or (writes_first(operation) and not isinstance(arguments[0], OnCard)):
        raise RuntimeError(f"{operation}: tensors of the CPU and of the card, {[tuple(x.shape) for x in strangers]}")


def refuse_generator(operation: Any, arguments: tuple, named: dict) -> None:
    """A card draws with a generator of its own, and this one has none."""
    if any(isinstance(x, torch.Generator) for x in (*arguments, *named.values())):
        raise RuntimeError(f"{operation}: a generator of the CPU draws for the card")


class Operations(TorchDispatchMode):
    """Every operation, also of those that make tensors out of nothing."""

    def __torch_dispatch__(self, operation: Any, types: Any, arguments: Any = (), named: Any = None) -> Any:
        return computed(operation, arguments, named or {})


class Lists(TorchFunctionMode):
    """A card's tensor as Python's numbers, which torch does below the operations."""

    def __torch_function__(
        self, function: Callable[..., Any], types: Any, arguments: Any = (), named: dict | None = None
    ) -> Any:
        if function is torch.Tensor.tolist and isinstance(arguments[0], OnCard):
            return arguments[0].cpu().tolist()
        return function(*arguments, **(named or {}))


def _room(size: Any, stride: Any, dtype: Any = None, **_: Any) -> OnCard:
    """aten::empty_strided: with the next, what `torch.tensor` needs, which goes past `Operations`."""
    return OnCard(torch.empty_strided(size, stride, dtype=dtype, device=CPU))


def _copied(to: Tensor, given: Tensor, *_: Any) -> Tensor:
    """aten::copy_."""
    held, numbers = (x.held if isinstance(x, OnCard) else x for x in (to, given))
    held.copy_(numbers)
    return to


KERNELS = torch.library.Library("aten", "IMPL")
KERNELS.impl("empty_strided", _room, "PrivateUse1")
KERNELS.impl("copy_", _copied, "PrivateUse1")


@contextmanager
def pretended_card() -> Iterator[torch.device]:
    """The device, as long as this lasts; gradients are computed in the asking thread, whose modes these are."""
    with Lists(), Operations(), torch.autograd.set_multithreading_enabled(False):
        yield CARD
