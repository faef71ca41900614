"""The options ``--recipe`` and ``--cities`` of ``streetfix train`` and ``streetfix simulate-training``."""

from typing import Annotated

import typer

from model_training.training.packs import PackPlan
from model_training.training.recipe import RECIPES, STOCK_CITIES
from service.errors import DatasetError

RecipeOption = Annotated[
    str,
    typer.Option(
        help="stock: cities with modelled depth errors. streets: 60 small cities, most with stereo-matched depth, from a small "
        "robot to a lorry. more-streets: 53 others of this kind. paper: the paper's city itself."
    ),
]
CitiesOption = Annotated[
    int | None,
    typer.Option(
        help=f"Cities of the stock recipe. Only this recipe takes the option.  [default: {STOCK_CITIES}]",
        min=1,
        max=1000,
        show_default=False,
    ),
]


def plans_of(recipe: str, cities: int | None) -> list[PackPlan]:
    """Return the cities of a recipe.

    Args:
        recipe: name of the recipe.
        cities: number of cities of the stock recipe; None for its default.

    Raises:
        DatasetError: there is no such recipe, or the recipe has fixed cities.
    """
    if recipe not in RECIPES:
        raise DatasetError(f"recipe: {recipe!r} is not valid; choose one of: {', '.join(RECIPES)}", field="recipe")
    if cities is not None and recipe != "stock":
        raise DatasetError(f"cities: the recipe {recipe!r} has fixed cities; omit --cities", field="cities")
    return RECIPES[recipe](cities or STOCK_CITIES)
